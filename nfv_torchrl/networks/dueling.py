"""The dueling network: how good the state is, and how much better an action is than the others."""

from __future__ import annotations

from torch import Tensor, nn

from nfv_torchrl.networks.base import QNetwork, Sizes
from nfv_torchrl.networks.layers import activation_class, perceptron
from nfv_torchrl.settings.values import Activation, Widths


class DuelingNetwork(QNetwork):
    r"""A common trunk, a value head and an advantage head.

    $$
    Q(s, a) = V(s) + A(s, a) - \frac{1}{|A_p(s)|} \sum_{a' \in A_p(s)} A(s, a')
    $$

    (Wang et al., "Dueling Network Architectures for Deep Reinforcement Learning", ICML 2016, eq. 9). The mean runs over
    the valid actions only: a node has some ten of them among hundreds, and with the classic mean over all actions
    $V$ would have to make up for advantages that mean nothing. So $V(s)$ is the mean value of what can be
    done.

    Reads ``observation`` float32 [..., P] and ``action_mask`` bool [..., A], returns values float32 [..., A], or
    [..., A, outputs].

    Args:
        sizes: sizes of observation and actions.
        outputs: outputs per action.
        hidden: neurons of each hidden layer; the last one is each head's own, those before it are the trunk.
        activation: name of a ``torch.nn`` activation.
        noisy: learned noise on the weights instead of epsilon-greedy exploration, see ``NoisyLinear``.
    """

    in_keys = ("observation", "action_mask")

    def __init__(
        self,
        sizes: Sizes,
        outputs: int = 1,
        *,
        hidden: Widths = (256, 256),
        activation: Activation = "ReLU",
        noisy: bool = False,
    ) -> None:
        super().__init__()
        self.outputs = outputs
        *trunk, last = hidden
        width = trunk[-1] if trunk else sizes.observation
        self.trunk: nn.Module = nn.Identity()
        if trunk:
            layers = perceptron(sizes.observation, width, trunk[:-1], activation, noisy=noisy)
            self.trunk = nn.Sequential(layers, activation_class(activation)())
        self.value = perceptron(width, outputs, [last], activation, noisy=noisy)
        self.advantage = perceptron(width, sizes.actions * outputs, [last], activation, noisy=noisy)

    def forward(self, observation: Tensor, action_mask: Tensor) -> Tensor:
        """Values of all actions."""
        features = self.trunk(observation)
        advantage = self.advantage(features).unflatten(-1, (-1, self.outputs))
        valid = action_mask.unsqueeze(-1)
        mean = (advantage * valid).sum(-2, keepdim=True) / valid.sum(-2, keepdim=True).clamp(min=1)
        values = self.value(features).unsqueeze(-2) + advantage - mean
        return values.squeeze(-1) if self.outputs == 1 else values
