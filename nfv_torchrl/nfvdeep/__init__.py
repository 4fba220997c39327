"""NFVdeep (Xiao et al., IWQoS 2019): each decision places one function on a node; routes and VMs follow from that."""

from nfv_torchrl.nfvdeep.env import NFVdeepEnv
from nfv_torchrl.nfvdeep.planner import NFVdeepPlanner
from nfv_torchrl.nfvdeep.reward import Profit

__all__ = ["NFVdeepEnv", "NFVdeepPlanner", "Profit"]
