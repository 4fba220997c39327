"""How a policy acts: at random, by the plans of a planner, by a trained network, or as a policy file says."""

from nfv_torchrl.methods.base import MayStop, Method, WholePlay, WholeWalks
from nfv_torchrl.methods.compiled import CompiledCandidates, CompiledNetwork, acting_method, fastest_method
from nfv_torchrl.methods.evolved import CandidatePolicy, Evolvable, PricePolicy
from nfv_torchrl.methods.from_config import methods_from_config
from nfv_torchrl.methods.planned import PlannerMethod
from nfv_torchrl.methods.policy import PolicyMethod
from nfv_torchrl.methods.policy_file import load_policy, load_weights, policy_content, save_policy
from nfv_torchrl.methods.random import RandomMethod

__all__ = [
    "CandidatePolicy",
    "CompiledCandidates",
    "CompiledNetwork",
    "Evolvable",
    "MayStop",
    "Method",
    "PlannerMethod",
    "PolicyMethod",
    "PricePolicy",
    "RandomMethod",
    "WholePlay",
    "WholeWalks",
    "acting_method",
    "fastest_method",
    "load_policy",
    "load_weights",
    "methods_from_config",
    "policy_content",
    "save_policy",
]
