"""What learns: Q-networks. A network says which keys it reads and which parts of the observation they come from."""

from nfv_torchrl.networks.base import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.networks.candidate import CandidateNetwork
from nfv_torchrl.networks.mlp import MLPNetwork

__all__ = ["CandidateNetwork", "MLPNetwork", "NetworkFactory", "QNetwork", "Sizes"]
