"""What a run writes to TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.window import TrainingWindow


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

    def iteration(
        self,
        progress: Progress,
        window: TrainingWindow,
        data: TensorDictBase,
        learning: TensorDictBase,
        **more: float,
    ) -> str:
        """Log what an iteration of a training has to say, and begin the next window.

        Args:
            progress: how far the run is, and how fast.
            window: what happened to the requests since the last call.
            data: the collected batch, [B, T].
            learning: what the last gradient step said, all [].
            more: further numbers, such as ``epsilon``.

        Returns:
            A few words for a progress bar.
        """
        values = window.metrics() | progress.speeds()
        more["reward"] = float(data["next", "reward"].mean())
        if "chosen_action_value" in data.keys():  # noqa: SIM118  a TensorDict iterates its batch; Q-actors alone have it
            more["chosen_q"] = float(data["chosen_action_value"].mean())
        more |= {key: float(value) for key, value in learning.items()}
        values |= {f"train/{key}": value for key, value in more.items()}
        self.scalars(values, progress.frames)
        window.reset()
        return f"AAR {values.get('train/aar', 0):.3f}  cost {values.get('train/cost_per_accepted', 0):.0f} $"

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
