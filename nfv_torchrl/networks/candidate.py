"""A network that scores each valid action with the same weights, for substrates of any size."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nfv_torchrl.networks.base import QNetwork, Sizes
from nfv_torchrl.networks.layers import perceptron
from nfv_torchrl.observations import CandidateObservation, ObservationPart
from nfv_torchrl.observations.candidates import count_features
from nfv_torchrl.settings.values import Activation, Width


class CandidateNetwork(QNetwork):
    """Shared weights over the rows of the candidate observation.

    Reads ``("candidates", "features")`` float32 [..., C, features], ``("candidates", "action")`` int64 [..., C],
    ``("candidates", "mask")`` bool [..., C] and ``action_mask`` bool [..., A], and writes each row's value to the place
    of its action; actions without a row get 0.

    Args:
        sizes: number of features, which says whether those of ``RequestFeatures`` are among them.
        outputs: outputs per action.
        hidden: neurons of each hidden layer.
        activation: name of a ``torch.nn`` activation.
        noisy: learned noise on the weights instead of epsilon-greedy exploration, see ``NoisyLinear``; the rows of one
            state share it.
    """

    in_keys = (("candidates", "features"), ("candidates", "action"), ("candidates", "mask"), "action_mask")
    any_size = True

    def __init__(
        self,
        sizes: Sizes,
        outputs: int = 1,
        *,
        hidden: Sequence[Width] = (64, 64),
        activation: Activation = "ReLU",
        noisy: bool = False,
    ) -> None:
        super().__init__()
        self.outputs, self.noisy = outputs, noisy
        self.features = sizes.candidate_features
        self._request = sizes.candidate_features > count_features(sizes.services, request=False)
        self.layers = perceptron(sizes.candidate_features, outputs, hidden, activation, noisy=noisy)

    def observations(self) -> list[ObservationPart]:
        """See ``QNetwork``."""
        return [CandidateObservation(request=self._request)]

    def forward(self, features: Tensor, action: Tensor, row_mask: Tensor, action_mask: Tensor) -> Tensor:
        """Values of all actions."""
        if torch._C._functorch.is_batchedtensor(row_mask):  # vmap allows no shapes that depend on data
            return self._values_of_all_rows(features, action, row_mask, action_mask)
        actions = action_mask.shape[-1]
        # Most rows are padding: leaving them out makes an update about four times as fast.
        used = row_mask.flatten().nonzero().squeeze(-1)
        state = used // row_mask.shape[-1]
        values = features.new_zeros(action_mask.numel(), self.outputs)
        values = values.index_copy(0, state * actions + action.flatten()[used], self._scores(features, used))
        values = values.view(*action_mask.shape, self.outputs)
        return values.squeeze(-1) if self.outputs == 1 else values

    def _values_of_all_rows(self, features: Tensor, action: Tensor, row_mask: Tensor, action_mask: Tensor) -> Tensor:
        """The same values, padding included in the work: rows not in use write to a column that is cut off again."""
        scores, actions = self.layers(features), action_mask.shape[-1]
        place = action.masked_fill(~row_mask, actions).unsqueeze(-1).expand_as(scores)
        values = scores.new_zeros(*action_mask.shape[:-1], actions + 1, self.outputs)
        values = values.scatter(-2, place, scores)[..., :actions, :]
        return values.squeeze(-1) if self.outputs == 1 else values

    def _scores(self, features: Tensor, used: Tensor) -> Tensor:
        """Outputs of the rows in use, [rows, outputs]; ``used`` int64 [rows] counts through all states."""
        if self.noisy:  # noise is drawn per state, so the rows have to stay in their states
            return self.layers(features).flatten(0, -2)[used]
        return self.layers(features.flatten(0, -2)[used])
