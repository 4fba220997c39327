"""A step of TorchRL's loop for environments that need no second look."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase


class LeanEnv(EnvBase):
    """An ``EnvBase`` whose ``_step`` returns all that its specs say, in their shapes and dtypes, on its own device.

    TorchRL completes and compares that in every step, and copies key by key what the next step begins with. For a small
    batch this takes several times as long as the step itself. Here it is left out, where a collector or a rollout asks
    for ``step_and_maybe_reset``; the results are the same. Whatever is out of the ordinary is left to TorchRL: keys
    below ``next`` that a policy has written, steps of a part of the batch, other devices, hooks and compiled steps.
    """

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """One step, and the first state of a new episode where one ended. See ``EnvBase``."""
        before = dict(tensordict.items())
        if not self._is_plain(tensordict, before):
            return super().step_and_maybe_reset(tensordict)
        after = self._step(tensordict)
        root = before | dict(after.items())
        tensordict.set("next", after)
        # As TorchRL's step_mdp has it: the reward is in ``next`` alone.
        return tensordict, self.maybe_reset(self._gather(root, ("reward", "_reset")))

    def _is_plain(self, tensordict: TensorDictBase, values: dict[str, Any]) -> bool:
        return (
            type(tensordict) is TensorDict
            and tensordict.batch_size == self.batch_size
            and tensordict.device == self.device
            and "next" not in values
            and "_step" not in values
            and self._post_step_mdp_hooks is None
            and "_compiled_step_and_maybe_reset" not in self.__dict__
            and not torch.compiler.is_compiling()
        )

    def _gather(self, values: dict[str, Any], but: tuple[str, ...] = ()) -> TensorDict:
        """``values`` in TensorDicts of their own, nested ones too: a key set in one is not set in the other."""
        source = {
            key: self._gather(dict(value.items())) if type(value) is TensorDict else value
            for key, value in values.items()
            if key not in but
        }
        return TensorDict._new_unsafe(source, batch_size=self.batch_size, device=self.device)
