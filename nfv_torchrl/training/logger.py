"""What a run writes to TensorBoard."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from tensordict import TensorDictBase
from torch.utils.tensorboard import SummaryWriter

from nfv_torchrl.training.clock import TrainingClock
from nfv_torchrl.training.hyperparameters import METRICS, hparams_summaries, hyperparameters
from nfv_torchrl.training.layout import Charts, as_layout, charts, written_always
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.series import ChangingSeries
from nfv_torchrl.training.setup import job_name
from nfv_torchrl.training.window import TrainingWindow

if TYPE_CHECKING:
    from nfv_torchrl.training.held_out import HeldOut
    from nfv_torchrl.training.references import References
    from nfv_torchrl.training.run import RunFolder

COLOURS = 64
"""Of a picture: a palette makes it a third as large, and nobody sees it."""
CARD = 350
"""Width of a picture in TensorBoard's tab "Images", pixels. It leaves out or repeats pixels of any other."""
BINS = 48
"""Of a histogram."""
__all__ = ["METRICS", "EventLog", "RunLogger"]


class EventLog:
    """Pictures, texts and histograms in the event files of a folder.

    Args:
        folder: where they go.
        purge: when resuming, TensorBoard drops what was logged from this frame on.
    """

    def __init__(self, folder: Path, purge: int | None = None) -> None:
        self.writer = SummaryWriter(str(folder), purge_step=purge)

    def figure(self, tag: str, figure: Figure, frames: int) -> None:
        """Log a matplotlib figure as an image, as wide as TensorBoard shows it."""
        drawn, packed = io.BytesIO(), io.BytesIO()
        figure.savefig(drawn, format="png", dpi=CARD / figure.get_figwidth())
        picture = (
            Image.open(drawn)
            .convert("RGB")
            .quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        )
        picture.save(packed, "png")
        image = Summary.Image(
            width=picture.width, height=picture.height, colorspace=3, encoded_image_string=packed.getvalue()
        )
        self._add(Summary(value=[Summary.Value(tag=tag, image=image)]), frames)

    def histogram(self, tag: str, values: torch.Tensor | np.ndarray, frames: int) -> None:
        """Log how numbers of any shape spread; what is not finite is left out, and of nothing there is none."""
        flat = torch.as_tensor(values).detach().cpu().flatten().double()
        flat = flat[flat.isfinite()]
        if len(flat):
            self.writer.add_histogram(tag, flat, frames, bins=BINS)  # type: ignore[arg-type]

    def text(self, tag: str, words: str, frames: int) -> None:
        """Log a text (Markdown)."""
        self.writer.add_text(tag, words, frames)

    def close(self) -> None:
        """Write what is still in memory."""
        self.writer.close()

    def _add(self, summary: Summary, frames: int | None = None) -> None:
        self.writer._get_file_writer().add_summary(summary, frames)


class RunLogger(EventLog):
    """Scalars, histograms, figures, the config and hyperparameters of one run.

    Series that never change are not written, but for those that others are read against (``training/layout.py``).

    Args:
        folder: of the run; the event files go there. When resuming, TensorBoard drops what was logged after the
            checkpoint that the run goes on from, and the series go on as they were.
        progress: how far the run is.

    Attributes:
        references: what the agent is compared with, once that is known.
        clock: processor time of the training, from ``start`` on; evaluations stop it.
        held_out: once that is known, networks on which the best policy is chosen, or None.
        apart: whether its lines are in event files of their own, in folders below that of the run: TensorBoard gives
            them colours and names of their own. The many runs of a sweep have them among their own series.
    """

    def __init__(self, folder: RunFolder, progress: Progress) -> None:
        purge = progress.frames + 1 if folder.resume else None
        super().__init__(folder.path, purge)
        self.series = ChangingSeries(written_always)
        self.resumed = folder.resume
        self.apart = not job_name()
        self._beside: dict[str, SummaryWriter] = {}
        self._purge, self._path = purge, folder.path
        self.references: References | None = None
        self.held_out: list[HeldOut | None] = []
        folder.carry("logged", self.series)
        self.clock = TrainingClock()
        folder.carry("clock", self.clock)

    def scalars(self, values: Mapping[str, float], frames: int) -> None:
        """Log each value under its tag."""
        for tag, value in values.items():
            for frame, point in self.series.points(tag, frames, float(value)):
                self.writer.add_scalar(tag, point, frame)

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
        values = window.metrics() | progress.speeds(self.clock.seconds)
        more["reward"] = float(data["next", "reward"].mean())
        if "chosen_action_value" in data.keys():  # noqa: SIM118  a TensorDict iterates its batch; Q-actors alone have it
            more["chosen_q"] = float(data["chosen_action_value"].mean())
        more |= {key: float(value) for key, value in learning.items()}
        values |= {f"train/{key}": value for key, value in more.items()}
        self.scalars(values, progress.frames)
        window.reset()
        return f"AAR {values.get('train/aar', 0):.3f}  cost {values.get('train/cost_per_accepted', 0):.0f} $"

    def compared(self, name: str, values: Mapping[str, float], frames: int) -> None:
        """Log metrics, by their names, of ``name``, which the agent is compared with.

        They have the agent's tags in a folder ``name`` below that of the run (``apart``), or in a sweep tags such as
        ``eval/aar_of/NAME``.
        """
        if not self.apart:
            self.scalars({f"eval/{key}_of/{name}": value for key, value in values.items()}, frames)
            return
        if name not in self._beside:
            self._beside[name] = SummaryWriter(str(self._path / name), purge_step=self._purge)
        for key, value in values.items():
            self._beside[name].add_scalar(f"eval/{key}", value, frames)

    def start(
        self, config_text: str, config: Mapping[str, Any], metrics: tuple[str, ...], layout: Charts | None = None
    ) -> None:
        """Log the config as text and its numbers as hyperparameters, and which series stand in one chart.

        ``metrics`` are the scalar tags that the HParams tab shows beside them. The summaries go into the run's own
        event file; ``SummaryWriter.add_hparams`` would open a run of its own for them. From now on the clock runs.
        """
        if not self.resumed:
            self.writer.add_text("config", f"```yaml\n{config_text}\n```", 0)
            evaluated = bool(config["eval"]["interval"])
            held_out = evaluated and config["eval"].get("networks") is not None
            shown = layout or charts(evaluated=evaluated, apart=self.apart, held_out=held_out)
            self.writer.add_custom_scalars(as_layout(shown))
        for summary in hparams_summaries(hyperparameters(config), metrics):
            self._add(summary)
        self.clock.start()

    def close(self) -> None:
        """Write what is still in memory."""
        self.clock.stop()
        for writer in (self.writer, *self._beside.values()):
            writer.close()
