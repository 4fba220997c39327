"""Saving and loading a replay buffer."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

_OWN_KEY = "index"
"""Key that ``TensorDictReplayBuffer`` writes itself."""


class MemoryState:
    """The state of a replay buffer: the items it holds and where the next one goes.

    The buffer's own ``state_dict`` holds its whole storage, uninitialised memory included.
    """

    def __init__(self, buffer: TensorDictReplayBuffer) -> None:
        self.buffer = buffer

    def state_dict(self) -> dict[str, Any]:
        """Items as a nested dict of tensors, in storage order."""
        if not len(self.buffer):
            return {"size": 0, "items": {}, "cursor": 0}
        items = self.buffer[:].exclude(_OWN_KEY)
        return {
            "size": len(self.buffer),
            "items": items.to("cpu").to_dict(),
            "cursor": self.buffer.writer.state_dict()["_cursor"],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Fill an empty buffer."""
        if not state["size"]:
            return
        self.buffer.extend(TensorDict(state["items"], batch_size=[state["size"]]))
        writer = self.buffer.writer
        writer.load_state_dict({**writer.state_dict(), "_cursor": state["cursor"]})
