"""One decision a request: choose one of the exact walks of its menu, or refuse it."""

from nfv_torchrl.plans.env import PlanEnv
from nfv_torchrl.plans.menus import Menus
from nfv_torchrl.plans.planner import MenuPlanner

__all__ = ["MenuPlanner", "Menus", "PlanEnv"]
