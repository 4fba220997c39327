"""How it learns: one file a loss. A recipe's yaml names the class by ``_target_``; there is no registry."""

from nfv_torchrl.losses.base import RequestLoss, greedy_actor
from nfv_torchrl.losses.dqn import DQN

__all__ = ["DQN", "RequestLoss", "greedy_actor"]
