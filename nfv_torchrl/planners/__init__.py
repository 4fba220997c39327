"""Planners: each answers a request with a whole embedding, as actions of the environment."""

from nfv_torchrl.planners.base import CompiledPlanner, Planner, over_rows
from nfv_torchrl.planners.first_fit import FirstFitPlanner
from nfv_torchrl.planners.greedy import GreedyPlanner
from nfv_torchrl.planners.learned_prices import LearnedPrices
from nfv_torchrl.planners.milp import MilpPlanner
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.planners.priced import PricedPlanner
from nfv_torchrl.planners.tabu import TabuPlanner

__all__ = [
    "CompiledPlanner",
    "FirstFitPlanner",
    "GreedyPlanner",
    "LearnedPrices",
    "MilpPlanner",
    "MyopicPlanner",
    "Planner",
    "PricedPlanner",
    "TabuPlanner",
    "over_rows",
]
