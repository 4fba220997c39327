"""What the losses of networks with memory share: sequences of steps as rows, and running over them."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.policy_gradient import masked_policy
from nfv_torchrl.networks import QNetwork


class SequenceLoss(MaskedLoss):
    """A loss of sequences. Each begins with the memory that was stored when it was collected.

    ``burn_in`` steps only bring the memory up to date with the present weights (Kapturowski et al., "Recurrent
    Experience Replay in Distributed Reinforcement Learning", ICLR 2019).

    ``prepare`` turns a batch [B, T] into B sequences: ``observation`` float32 [T + 1, P] and ``action_mask`` bool
    [T + 1, A], of the T steps and of what followed the last; ``restart`` bool [T + 1], steps that begin a horizon;
    ``memory`` float32 [H] before the first; ``action`` int64 [T], ``reward`` float32 [T] and ``stop`` bool [T]. So
    sizes of a replay memory, of its batches and of a minibatch count sequences.

    Args:
        network: one with ``unroll``, as ``GRUNetwork`` has it.
        burn_in: first steps of a sequence that are not learned from.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests. The memory goes
            across requests in either case.

    Raises:
        ScenarioError: the network has no memory, negative ``burn_in``.
    """

    def __init__(self, network: QNetwork, *, burn_in: int = 0, stop_at: str = "request_done") -> None:
        if burn_in < 0:
            raise ScenarioError(f"loss.burn_in is {burn_in}; use 0 or more steps")
        if not hasattr(network, "unroll"):
            kind = type(network).__name__
            raise ScenarioError(f"{kind} has no memory; use a network that has one, such as network=gru")
        super().__init__(network, stop_at=stop_at)
        self.burn_in = burn_in

    @property
    def in_keys(self) -> list[str]:
        """What ``forward`` reads."""
        return ["observation", "action_mask", "restart", "memory", "action", "reward", "stop"]

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """One sequence for each environment of [B, T]."""
        after = data.get("next")
        if data.shape[1] <= self.burn_in:
            raise ScenarioError(f"loss.burn_in is {self.burn_in}; collector.steps={data.shape[1]} must be larger")

        def with_next(key: str) -> Tensor:
            return torch.cat([data.get(key), after.get(key)[:, -1:]], 1)

        done = after.get("done").squeeze(-1)
        return TensorDict(
            {
                "observation": with_next("observation"),
                "action_mask": with_next("action_mask"),
                "restart": torch.cat([torch.zeros_like(done[:, :1]), done], 1),
                "memory": data.get("memory")[:, 0],
                "action": data.get("action"),
                "reward": after.get("reward").squeeze(-1),
                "stop": after.get(self.tensor_keys.done).squeeze(-1) | done,
            },
            batch_size=data.shape[:1],
        )

    def unrolled(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """What the network gives under ``params``, [batch, T + 1 - burn_in, A], or [..., A, outputs]; no mask yet."""
        seen, restart, memory = (tensordict.get(key) for key in ("observation", "restart", "memory"))
        k = self.burn_in
        with params.to_module(self.value_network):
            network: QNetwork = self.value_network  # type: ignore[assignment]
            if k:
                with torch.no_grad():
                    _, memory = network.unroll(seen[:, :k], memory, restart[:, :k])  # type: ignore[operator]
            values, _ = network.unroll(seen[:, k:], memory, restart[:, k:])  # type: ignore[operator]
        return values


def sequence_priority(error: Tensor) -> Tensor:
    """0.9 of a sequence's largest error and 0.1 of its mean, from errors of at least 0, [batch, T] to [batch, 1].

    A mean alone would hide the one step that is to be learned from (Kapturowski et al. 2019, section 2.3).
    """
    return 0.9 * error.amax(-1, keepdim=True) + 0.1 * error.mean(-1, keepdim=True)


class FirstOutput(nn.Module):
    """The first output per action of a network with memory, float32 [..., A], and the memory after the step."""

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        values, memory = self.network(*inputs)
        return values[..., 0], memory


def recurrent_policy(network: QNetwork, actions: int) -> ProbabilisticActor:
    """The softmax policy over valid actions whose log-odds are the network's first output.

    It samples while it explores and takes the most probable valid action otherwise. Writes ``logits`` float32 [..., A],
    ``action`` int64 [...], ``action_log_prob`` float32 [...] and ``("next", "memory")``.
    """
    keys = ["logits", ("next", "memory")]
    return masked_policy(TensorDictModule(FirstOutput(network), in_keys=list(network.in_keys), out_keys=keys), actions)
