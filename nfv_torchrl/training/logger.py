"""What a run writes to TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams


class RunLogger:
    """Scalars, figures, the config and hyperparameters of one run.

    Args:
        folder: where the event files go.
        frames: when resuming, the frame the run goes on from; TensorBoard then drops what was logged after it.
    """

    def __init__(self, folder: Path, frames: int | None = None) -> None:
        purge = None if frames is None else frames + 1
        self.writer = SummaryWriter(str(folder), purge_step=purge)

    def scalars(self, values: Mapping[str, float], frames: int) -> None:
        """Log each value under its tag."""
        for tag, value in values.items():
            self.writer.add_scalar(tag, value, frames)

    def figure(self, tag: str, figure: Figure, frames: int) -> None:
        """Log a matplotlib figure as an image, and close it."""
        self.writer.add_figure(tag, figure, frames, close=True)

    def start(self, config_text: str, config: Mapping[str, Any], metrics: tuple[str, ...]) -> None:
        """Log the config as text and its numbers as hyperparameters.

        ``metrics`` are the scalar tags that the HParams tab shows beside them. The summaries go into the run's own
        event file; ``SummaryWriter.add_hparams`` would open a run of its own for them.
        """
        self.writer.add_text("config", f"```yaml\n{config_text}\n```", 0)
        for summary in hparams(flat_values(config), dict.fromkeys(metrics, 0.0)):
            self.writer._get_file_writer().add_summary(summary)

    def close(self) -> None:
        """Write what is still in memory."""
        self.writer.close()


def flat_values(config: Mapping[str, Any], prefix: str = "") -> dict[str, bool | float | str]:
    """Nested config as flat ``a.b`` keys, with values the HParams tab can show."""
    flat: dict[str, bool | float | str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= flat_values(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value if isinstance(value, bool | int | float | str) else str(value)
    return flat
