"""A hand-made task: one number observed, four actions, the values of every state given by a table."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from nfv_torchrl.networks import QNetwork, Sizes

SIZES = Sizes(observation=1, actions=4, services=1, candidate_features=1)
HERE, THERE = 0.0, 1.0
"""Observations of the two states."""


class TableNetwork(QNetwork):
    """Values of state 0 and 1 from a table, [2, A] or [2, A, outputs]."""

    in_keys = ("observation",)

    def __init__(self, table: Tensor) -> None:
        super().__init__()
        self.table = nn.Parameter(table.clone())

    def forward(self, observation: Tensor) -> Tensor:
        return self.table[observation.squeeze(-1).long()]


def table_network(*tables):
    """A network factory; several tables are used one after the other, as a loss asks for networks."""
    left = [torch.as_tensor(table, dtype=torch.float32) for table in tables]

    def factory(sizes: Sizes, outputs: int = 1) -> TableNetwork:
        return TableNetwork(left.pop(0) if len(left) > 1 else left[0])

    return factory


def transition(*, action: int, mask, reward: float, next_mask, done: bool, end_of_horizon: bool = False) -> TensorDict:
    """One transition from state 0 to state 1, batch size [1]."""
    return TensorDict(
        {
            "observation": torch.tensor([[HERE]]),
            "action_mask": torch.tensor([mask], dtype=torch.bool),
            "action": torch.tensor([action]),
            "next": TensorDict(
                {
                    "observation": torch.tensor([[THERE]]),
                    "action_mask": torch.tensor([next_mask], dtype=torch.bool),
                    "reward": torch.tensor([[reward]]),
                    "request_done": torch.tensor([[done]]),
                    "done": torch.tensor([[end_of_horizon]]),
                    "terminated": torch.tensor([[end_of_horizon]]),
                },
                batch_size=[1],
            ),
        },
        batch_size=[1],
    )


def set_target(loss, name: str, *tables) -> None:
    """Give the target network tables of its own."""
    params = getattr(loss, f"target_{name}_params")
    leaves = [leaf for _, leaf in sorted(params.items(True, True), key=lambda item: str(item[0]))]
    for leaf, table in zip(leaves, tables, strict=True):
        leaf.data.copy_(torch.as_tensor(table, dtype=torch.float32))
