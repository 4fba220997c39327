"""NFVdeep (Xiao et al., IWQoS 2019): a policy places one function a decision, routes and VMs follow."""

from nfv_torchrl.nfvdeep.env import NFVdeepEnv
from nfv_torchrl.nfvdeep.planner import NFVdeepPlanner
from nfv_torchrl.nfvdeep.reward import Profit

__all__ = ["NFVdeepEnv", "NFVdeepPlanner", "Profit"]
