"""The settings of every recipe: one dataclass each, checked before anything is made or moved.

A group such as ``loss`` or ``method`` names its class by ``_target_``; its arguments are checked against the signature
of that class. Everything else is a key with a type.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.comparisons import (
    BenchmarkSettings,
    CompareLossesSettings,
    EvaluateSettings,
    FieldSettings,
    FiguresSettings,
    MilpGapSettings,
    TimeToQualitySettings,
    TransferSettings,
    TunePricedSettings,
)
from nfv_torchrl.settings.torchrl_losses import forget_other_loss
from nfv_torchrl.settings.trainings import DqnSettings, EvolutionSettings, OfflineSettings, PolicyGradientSettings
from nfv_torchrl.settings.values import parse_dataclass

Settings = TypeVar("Settings")

RECIPES: dict[str, type] = {
    "benchmark": BenchmarkSettings,
    "compare_losses": CompareLossesSettings,
    "dqn": DqnSettings,
    "evaluate": EvaluateSettings,
    "evolution": EvolutionSettings,
    "field": FieldSettings,
    "figures": FiguresSettings,
    "milp_gap": MilpGapSettings,
    "offline": OfflineSettings,
    "policy_gradient": PolicyGradientSettings,
    "time_to_quality": TimeToQualitySettings,
    "transfer": TransferSettings,
    "tune_priced": TunePricedSettings,
}


def read_settings(config: DictConfig | Mapping[str, Any], kind: type[Settings]) -> Settings:
    """The settings of a recipe, checked key by key.

    Raises:
        ScenarioError: an unknown or missing key, a value of the wrong kind or out of range, or values that do not go
            together.
    """
    if isinstance(config, DictConfig):
        config = _plain(config)
    return parse_dataclass(kind, config, "")


def check_recipe(name: str, overrides: Sequence[str], recipes: Path) -> None:
    """Check what ``recipes/NAME.py`` would be started with, without starting it.

    Raises:
        HydraException: overrides that Hydra cannot use.
        ScenarioError: see ``read_settings``.
    """
    if name == "milp_gap":
        options = dict(text.split("=", 1) for text in overrides)
        read_settings({"seeds": 10, "requests": 30, **{key: int(text) for key, text in options.items()}}, RECIPES[name])
        return
    with initialize_config_dir(str(recipes.resolve() / "config"), version_base=None):
        config = compose(name, list(overrides))
        forget_other_loss(config, overrides)
        read_settings(config, RECIPES[name])


def _plain(config: DictConfig) -> Mapping[str, Any]:
    """Without interpolations."""
    try:
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[return-value]
    except MissingMandatoryValue as error:
        raise ScenarioError(f"{error.full_key}: is missing; set it") from error
    except InterpolationToMissingValueError as error:
        name = str(error).splitlines()[0].rpartition(": ")[2]
        raise ScenarioError(f"{name}: is missing; set it ({error.full_key} needs it)") from error
    except OmegaConfBaseException as error:
        why = str(error).splitlines()[0]
        raise ScenarioError(f"{error.full_key or 'the settings'}: {why}; check what is between the braces") from error
