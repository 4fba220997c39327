"""Behaviour cloning: learning to repeat recorded decisions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_argmax, masked_log_softmax
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Positive


class Imitation(MaskedLoss):
    r"""Cross-entropy of the recorded actions under a softmax over valid actions.

    $$
    - \log \frac{e^{f(s, a) / \tau}}{\sum_{b \in A_p(s)} e^{f(s, b) / \tau}}
    $$

    with f the network's output and $\tau$ the temperature (Pomerleau, "ALVINN", NeurIPS 1988; Bojarski et al.,
    2016). It needs no reward and looks at no next state. The weights are preferences and no values: they start a
    policy-gradient loss well, and Q-learning only after its values have been learned anew. A small temperature keeps
    them as far apart as values are, so that Q-learning that begins with them (``init_from`` of ``recipes/dqn.py``) has
    less to unlearn.

    Args:
        network: factory of the network.
        sizes: sizes of observation and actions.
        temperature: tau.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A] and ``action`` int64 []. Writes ``loss`` []. Logs
    ``agreement`` []: the share of recorded actions that the greedy policy would take, too.
    """

    out_keys = ["loss", "agreement"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(self, network: NetworkFactory, sizes: Sizes, *, temperature: Positive = 1.0) -> None:
        if temperature <= 0:
            raise ScenarioError(f"loss.temperature is {temperature}; it must be above 0")
        preferences = network(sizes)
        super().__init__(preferences)
        self.temperature = temperature
        actor = greedy_actor(preferences, sizes.actions)
        self.adopt(preferences, actor=actor, name="actor_network", target=False)

    @property
    def in_keys(self) -> list:
        """What ``forward`` reads."""
        return [key for key in super().in_keys if not (isinstance(key, tuple) and key[0] == "next")]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of recorded decisions."""
        logits, mask, action = self.outputs("actor_network", tensordict), self.mask(tensordict), self.action(tensordict)
        loss = -masked_log_softmax(logits / self.temperature, mask).gather(-1, action).mean()
        with torch.no_grad():
            agreement = (masked_argmax(logits, mask) == action).float().mean()
        return TensorDict({"loss": loss, "agreement": agreement})
