"""Losses: how a network learns. Each has its own file. A yaml names the class by ``_target_``; there is no registry."""

from nfv_torchrl.losses.a2c import A2C
from nfv_torchrl.losses.across_requests import AcrossRequests
from nfv_torchrl.losses.actors import greedy_actor, q_network, scorer
from nfv_torchrl.losses.base import MaskedLoss, RequestLoss, has_target
from nfv_torchrl.losses.centred import CentredDQN
from nfv_torchrl.losses.cql import CQL
from nfv_torchrl.losses.differential import DifferentialDQN
from nfv_torchrl.losses.discrete_sac import DiscreteSAC
from nfv_torchrl.losses.dqn import DQN
from nfv_torchrl.losses.imitation import Imitation
from nfv_torchrl.losses.iqn import IQN
from nfv_torchrl.losses.munchausen import MunchausenDQN
from nfv_torchrl.losses.n_step import NStepDQN
from nfv_torchrl.losses.paper_literal import PaperLiteral
from nfv_torchrl.losses.policy_gradient import PolicyGradient
from nfv_torchrl.losses.ppo import PPO
from nfv_torchrl.losses.quantile import QuantileDQN
from nfv_torchrl.losses.rainbow import Rainbow
from nfv_torchrl.losses.rdpg import RDPG
from nfv_torchrl.losses.recurrent_dqn import RecurrentDQN
from nfv_torchrl.losses.recurrent_ppo import RecurrentPPO
from nfv_torchrl.losses.reinforce import Reinforce
from nfv_torchrl.losses.slot_discount import SlotDiscountDQN
from nfv_torchrl.losses.torchrl_losses import request_loss

__all__ = [
    "A2C",
    "CQL",
    "DQN",
    "IQN",
    "PPO",
    "RDPG",
    "AcrossRequests",
    "CentredDQN",
    "DifferentialDQN",
    "DiscreteSAC",
    "Imitation",
    "MaskedLoss",
    "MunchausenDQN",
    "NStepDQN",
    "PaperLiteral",
    "PolicyGradient",
    "QuantileDQN",
    "Rainbow",
    "RecurrentDQN",
    "RecurrentPPO",
    "Reinforce",
    "RequestLoss",
    "SlotDiscountDQN",
    "greedy_actor",
    "has_target",
    "q_network",
    "request_loss",
    "scorer",
]
