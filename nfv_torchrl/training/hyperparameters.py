"""What TensorBoard's HParams tab shows of a run: the settings that tell runs apart first, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

Value = bool | float | str

METRICS = ("eval/aar", "eval/paired_cost/greedy", "eval/paired_cost/myopic_optimal", "eval/cost_per_accepted")
"""What the tab shows beside the settings: the last values."""
FIRST = {
    "loss._target_": "loss",
    "policy._target_": "policy",
    "network._target_": "network",
    "learner.lr": "lr",
    "strategy.sigma": "sigma",
    "loss.gamma": "gamma",
    "seed": "seed",
    "collector.total_frames": "frames",
    "generations": "generations",
    "buffer.size": "buffer",
    "scenario.name": "scenario",
}
"""Settings that come first, and what the tab calls them."""
LEFT_OUT = ("run_dir", "resume", "logger.", "saving.", "eval.", "device", "threads", "env_threads")
"""What says where a run is kept and how often it is looked at."""


def hyperparameters(config: Mapping[str, Any]) -> dict[str, Value]:
    """The settings as the tab shows them: those of ``FIRST``, in few words, before all others."""
    flat = flat_values(config)
    named = {name: flat.pop(key) for key, name in FIRST.items() if key in flat}
    for name in ("loss", "policy", "network"):
        if name in named:
            named[name] = " ".join([class_name(named[name]).removesuffix("Network"), *_more(config[name])])
    sampler = flat.pop("buffer.sampler._target_", None)
    if sampler is not None:
        kind = class_name(sampler).removesuffix("Sampler").lower()
        named["buffer"] = f"{kind} {named.get('buffer', '')}".strip()
    return named | {key: value for key, value in flat.items() if not key.startswith(LEFT_OUT)}


def hparams_summaries(settings: Mapping[str, Value], metrics: Sequence[str]) -> list[Summary]:
    """The summaries by which TensorBoard knows a run's settings and metrics.

    It sorts columns by name and shows the first five of those that are said to differ, so the settings of ``FIRST`` get
    numbers in front of their names, which are not shown.
    """
    first = [name for name in FIRST.values() if name in settings]
    named = {f"{first.index(name):02d} {name}" if name in first else name: name for name in settings}
    infos = [
        api_pb2.HParamInfo(name=key, display_name=name, type=_kind(settings[name]), differs=name in first)
        for key, name in named.items()
    ]
    shown = [api_pb2.MetricInfo(name=api_pb2.MetricName(tag=tag), display_name=_metric(tag)) for tag in metrics]
    start = plugin_data_pb2.SessionStartInfo()
    for key, name in named.items():
        value = settings[name]
        if isinstance(value, bool):
            start.hparams[key].bool_value = value
        elif isinstance(value, int | float):
            start.hparams[key].number_value = value
        else:
            start.hparams[key].string_value = value
    parts = {
        metadata.EXPERIMENT_TAG: {"experiment": api_pb2.Experiment(hparam_infos=infos, metric_infos=shown)},
        metadata.SESSION_START_INFO_TAG: {"session_start_info": start},
        metadata.SESSION_END_INFO_TAG: {"session_end_info": plugin_data_pb2.SessionEndInfo(status=_SUCCESS)},
    }
    return [_summary(tag, plugin_data_pb2.HParamsPluginData(**part)) for tag, part in parts.items()]


_SUCCESS = api_pb2.Status.Value("STATUS_SUCCESS")


def _summary(tag: str, data: plugin_data_pb2.HParamsPluginData) -> Summary:
    return Summary(
        value=[Summary.Value(tag=tag, metadata=metadata.create_summary_metadata(data), tensor=metadata.NULL_TENSOR)]
    )


def _kind(value: Value) -> int:
    name = "BOOL" if isinstance(value, bool) else "FLOAT64" if isinstance(value, int | float) else "STRING"
    return api_pb2.DataType.Value(f"DATA_TYPE_{name}")


def _metric(tag: str) -> str:
    """What the tab calls a metric: ``AAR``, ``paired cost greedy``."""
    return tag.partition("/")[2].replace("/", " ").replace("_", " ").replace("aar", "AAR")


def _more(part: Mapping[str, Any]) -> list[str]:
    """What tells parts of a class apart, in short: ``256-256``, ``noisy``, ``double``."""
    hidden = part.get("hidden")
    widths = ["-".join(map(str, hidden))] if isinstance(hidden, list | tuple) and hidden else []
    return widths + [key for key, value in part.items() if value is True and not key.startswith("_")]


def class_name(path: Any) -> str:
    """``DQN`` of ``nfv_torchrl.losses.DQN``."""
    return str(path).rpartition(".")[2]


def flat_values(config: Mapping[str, Any], prefix: str = "") -> dict[str, bool | float | str]:
    """Nested config as flat ``a.b`` keys, with values the HParams tab can show."""
    flat: dict[str, bool | float | str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= flat_values(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value if isinstance(value, bool | int | float | str) else str(value)
    return flat
