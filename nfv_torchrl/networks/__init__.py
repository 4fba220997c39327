"""Q-networks. A network says which keys it reads and which parts of the observation provide them."""

from nfv_torchrl.networks.base import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.networks.candidate import CandidateNetwork
from nfv_torchrl.networks.dueling import DuelingNetwork
from nfv_torchrl.networks.gru import GRUNetwork
from nfv_torchrl.networks.implicit import ImplicitQuantileNetwork
from nfv_torchrl.networks.layers import NoisyLinear
from nfv_torchrl.networks.lookahead import LookaheadNetwork
from nfv_torchrl.networks.menu import MenuNetwork
from nfv_torchrl.networks.mlp import MLPNetwork

__all__ = [
    "CandidateNetwork",
    "DuelingNetwork",
    "GRUNetwork",
    "ImplicitQuantileNetwork",
    "LookaheadNetwork",
    "MLPNetwork",
    "MenuNetwork",
    "NetworkFactory",
    "NoisyLinear",
    "QNetwork",
    "Sizes",
]
