"""A Q-network with memory: its values depend on earlier steps and earlier requests, too."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nfv_torchrl.networks.base import QNetwork, Sizes, split_outputs
from nfv_torchrl.networks.layers import check_weights_fit
from nfv_torchrl.observations import MemoryObservation, ObservationPart
from nfv_torchrl.settings.values import Width


class GRUNetwork(QNetwork):
    r"""A gated recurrent unit between a layer that encodes the observation and one that gives the values.

    $$
    x_t = \mathrm{ReLU}(W_e o_t + b_e), \quad h_{t+1} = \mathrm{GRU}(x_t, h_t), \quad
    Q(s_t, \cdot) = W_q [x_t, h_{t+1}] + b_q
    $$

    (Cho et al., "Learning Phrase Representations using RNN Encoder-Decoder for Statistical Machine Translation", EMNLP
    2014; for Q-learning: Hausknecht, Stone, "Deep Recurrent Q-Learning for Partially Observable MDPs", 2015). The
    memory $h$ goes on from request to request and is zero at the beginning of a horizon, so that the arrivals so
    far can tell what the observation does not: the current load of each service, how long requests stay.

    Reads ``observation`` float32 [..., P] and ``memory`` float32 [..., H], returns values float32 [..., A] (or
    [..., A, outputs]) and the memory for the next step, which an actor has to write to ``("next", "memory")``: use it
    with ``nfv_torchrl.losses.RecurrentDQN``.

    Args:
        sizes: sizes of observation and actions.
        outputs: outputs per action.
        hidden: H, neurons of each layer and size of the memory.
    """

    in_keys = ("observation", "memory")

    def __init__(self, sizes: Sizes, outputs: int = 1, *, hidden: Width = 128) -> None:
        super().__init__()
        self.outputs, self.hidden = outputs, hidden
        check_weights_fit(hidden, hidden * (6.0 * hidden + sizes.observation + 2.0 * sizes.actions * outputs))
        self.encode = nn.Sequential(nn.Linear(sizes.observation, hidden), nn.ReLU())
        self.cell = nn.GRUCell(hidden, hidden)
        self.values = nn.Linear(2 * hidden, sizes.actions * outputs)

    def observations(self) -> list[ObservationPart]:
        """See ``QNetwork``."""
        return [MemoryObservation(self.hidden)]

    def forward(self, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """One step: values and next memory."""
        seen = self.encode(observation)
        after = self.cell(seen.reshape(-1, self.hidden), memory.reshape(-1, self.hidden)).view_as(memory)
        return self._read(seen, after), after

    def unroll(self, observation: Tensor, memory: Tensor, restart: Tensor) -> tuple[Tensor, Tensor]:
        """A sequence of steps.

        Args:
            observation: float32 [B, T, P].
            memory: before the first step, float32 [B, H].
            restart: steps that begin a horizon, with a memory of zeros, bool [B, T].

        Returns:
            Values [B, T, A] (or [B, T, A, outputs]) and the memory after the last step [B, H].
        """
        seen = self.encode(observation)
        memories = []
        for step, begins in zip(seen.unbind(1), restart.unbind(1), strict=True):
            memory = self.cell(step, memory.masked_fill(begins.unsqueeze(-1), 0.0))
            memories.append(memory)
        return self._read(seen, torch.stack(memories, 1)), memory

    def _read(self, seen: Tensor, memory: Tensor) -> Tensor:
        return split_outputs(self.values(torch.cat([seen, memory], -1)), self.outputs)
