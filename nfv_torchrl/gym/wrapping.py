"""The Gymnasium environment in TorchRL's ``GymWrapper``, with its mask."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import GymWrapper
from torchrl.envs.gym_like import BaseInfoDictReader

from nfv_torchrl.simulator import REASON_NAMES
from nfv_torchrl.simulator.reasons import NO_REASON


class InfoReader(BaseInfoDictReader):
    """Writes what ``NFVGymEnv`` has in ``info`` into TorchRL's data: the mask as ``bool``, the rest by name."""

    def __init__(self, actions: int) -> None:
        flag = Binary(1, shape=(1,), dtype=torch.bool)
        self._spec = Composite(
            action_mask=Binary(actions, shape=(actions,), dtype=torch.bool),
            request_done=flag,
            accepted=flag.clone(),
            rejection_reason=Bounded(NO_REASON, len(REASON_NAMES) - 1, (1,), dtype=torch.int64),
            request_cost=Unbounded((1,), dtype=torch.float32),
        )

    @property
    def info_spec(self) -> Composite:
        """Specs of the keys it writes."""
        return self._spec

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        """Write the keys of ``info_dict`` into ``tensordict`` []."""
        for name, spec in self._spec.items():
            tensordict.set(name, torch.as_tensor(info_dict[name], dtype=spec.dtype).reshape(spec.shape))
        return tensordict


def wrap_for_torchrl(env: gymnasium.Env, **options: Any) -> GymWrapper:
    """``env`` in TorchRL's ``GymWrapper``, which by itself drops ``info`` and with it the mask.

    ``NFVEnv`` is TorchRL's own and faster; this is for code that starts from a Gymnasium environment, wrappers of yours
    around it included. ``action`` is categorical. Beside TorchRL's keys there are ``action_mask`` bool [2 N V + 1] and,
    [1] each, the other entries of ``info``. TorchRL's ``ActionMask`` keeps random actions to the mask::

        env = wrap_for_torchrl(gymnasium.make("nfv_torchrl/NFV-v0"))
        TransformedEnv(env, ActionMask()).rollout(100)

    Args:
        env: an ``NFVGymEnv``, wrapped or not.
        options: further arguments of ``GymWrapper``.
    """
    wrapped = GymWrapper(env, categorical_action_encoding=True, **options)
    return wrapped.set_info_dict_reader(InfoReader(int(env.action_space.n)))  # type: ignore[attr-defined]
