"""Planners: from one request and what the network offers to a whole embedding, as actions of the environment."""

from nfv_torchrl.planners.base import Planner
from nfv_torchrl.planners.cheapest import Scratch, grow_scratch, make_scratch, plan_cheapest
from nfv_torchrl.planners.greedy import GreedyPlanner
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.planners.priced import PricedPlanner
from nfv_torchrl.planners.tabu import TabuPlanner

__all__ = [
    "GreedyPlanner",
    "MyopicPlanner",
    "Planner",
    "PricedPlanner",
    "Scratch",
    "TabuPlanner",
    "grow_scratch",
    "make_scratch",
    "plan_cheapest",
]
