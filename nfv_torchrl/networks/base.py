"""The interface of a Q-network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from torch import Tensor, nn

from nfv_torchrl.observations import ObservationPart
from nfv_torchrl.observations.candidates import count_features, describes_requests
from nfv_torchrl.simulator import Simulator


class Sizes(NamedTuple):
    """The sizes that a network may depend on."""

    observation: int  # P, of the flat observation
    actions: int  # with reject: 2 N V + 1
    services: int  # K types
    candidate_features: int

    @classmethod
    def of(cls, simulator: Simulator) -> Sizes:
        """The sizes of ``simulator``'s observations and actions."""
        services = simulator.tables.services
        return cls(
            observation=simulator.world.seen.flat.shape[1],
            actions=simulator.num_actions,
            services=services,
            candidate_features=count_features(services, request=describes_requests(simulator.world)),
        )


class QNetwork(nn.Module):
    """A module ``forward(*inputs) -> values``, one input for each of ``in_keys``.

    ``values`` are float32 [..., A], or [..., A, outputs] where a loss asks for several outputs per action (the
    quantiles of a distribution, say). Values of invalid actions may be anything; the mask is applied outside.

    A network that values one action sooner than all may have a method ``values_of(*inputs, action)``, too, with
    ``action`` int64 [B, 1]: its values, float32 [B, outputs], to within rounding. Losses across requests ask it.

    Attributes:
        in_keys: the keys it reads from a TensorDict.
        any_size: whether the same weights serve substrates of any size.
        any_services: whether they serve any number of service types, too.
        takes_levels: whether it takes levels of quantiles after its inputs, as ``ImplicitQuantileNetwork`` does.
    """

    in_keys: Sequence
    any_size: bool = False
    any_services: bool = False
    takes_levels: bool = False

    def observations(self) -> list[ObservationPart]:
        """The parts of the observation it needs beside ``observation`` and ``action_mask``."""
        return []


class NetworkFactory(Protocol):
    """What a network's yaml (``_partial_: true``) becomes."""

    def __call__(self, sizes: Sizes, outputs: int = 1) -> QNetwork: ...


def split_outputs(values: Tensor, outputs: int) -> Tensor:
    """[..., A * outputs] to [..., A, outputs], or to [..., A] when there is one output per action."""
    return values if outputs == 1 else values.unflatten(-1, (-1, outputs))
