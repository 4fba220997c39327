"""TorchRL's own loss classes as settings: which serve here, in which recipes, and what may be set of each.

TorchRL's signatures say little about values, and some swallow names that they do not know (``**kwargs``). So what may
be set stands here, with its kind. ``nfv_torchrl.losses.torchrl_losses`` makes the losses.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from omegaconf import DictConfig, open_dict

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.targets import OF_HYDRA, Target, locate, written_hints
from nfv_torchrl.settings.values import (
    Bounds,
    Count,
    Distance,
    NotNegative,
    OneOf,
    Positive,
    Quantiles,
    Share,
    StopKey,
    join,
    parse,
    refuse_key,
)

LOSS_MODULE = "torchrl.objectives.common.LossModule"
Reduction = Annotated[str, OneOf("mean", "sum")]
Auto = Annotated[str, OneOf("auto")]
Weights = bool | Auto
"""Whether the weights of a prioritised memory count; ``auto``: where there are any."""
Expectile = Annotated[float, Bounds(above=0, at_most=0.999)]
Ratio = Annotated[float, Bounds(above=0, at_most=0.999)]
"""How far a probability ratio may be from 1."""

LOOKING_AHEAD = {"gamma": Share, "stop_at": StopKey}
Q_LEARNING = {**LOOKING_AHEAD, "loss_function": Distance, "delay_value": bool, "reduction": Reduction}
TWO_CRITICS = {
    **LOOKING_AHEAD,
    "num_qvalue_nets": Count,
    "loss_function": Distance,
    "separate_losses": bool,
    "reduction": Reduction,
}
ADVANTAGES = {
    **LOOKING_AHEAD,
    "lmbda": Share,
    "loss_critic_type": Distance,
    "separate_losses": bool,
    "reduction": Reduction,
}
WITH_ENTROPY = {
    **ADVANTAGES,
    "entropy_bonus": bool,
    "samples_mc_entropy": Count,
    "entropy_coeff": NotNegative | None,
    "critic_coeff": NotNegative | None,
}


@dataclass(frozen=True)
class TorchRLLoss:
    """A class of TorchRL that serves here.

    Attributes:
        learns_from: what it learns from: a ``memory`` (``dqn.py``, ``offline.py``) or the ``present`` policy's latest
            batch (``policy_gradient.py``).
        settings: what may be set, with the kind of its values; the networks are made from ``network``.
    """

    learns_from: Literal["memory", "present"]
    settings: Mapping[str, Any]


SERVED: Mapping[str, TorchRLLoss] = {
    "torchrl.objectives.dqn.DQNLoss": TorchRLLoss(
        "memory", {**Q_LEARNING, "double_dqn": bool, "use_prioritized_weights": Weights}
    ),
    "torchrl.objectives.dqn.DistributionalDQNLoss": TorchRLLoss(
        "memory",
        {
            **LOOKING_AHEAD,
            "atoms": Quantiles,
            "v_min": float,
            "v_max": float,
            "delay_value": bool,
            "reduction": Reduction,
            "use_prioritized_weights": Weights,
        },
    ),
    "torchrl.objectives.cql.DiscreteCQLLoss": TorchRLLoss("memory", Q_LEARNING),
    "torchrl.objectives.iql.DiscreteIQLLoss": TorchRLLoss(
        "memory", {**TWO_CRITICS, "temperature": NotNegative, "expectile": Expectile}
    ),
    "torchrl.objectives.sac.DiscreteSACLoss": TorchRLLoss(
        "memory",
        {
            **TWO_CRITICS,
            "alpha_init": Positive,
            "min_alpha": Positive | None,
            "max_alpha": Positive | None,
            "fixed_alpha": bool,
            "target_entropy_weight": Share,
            "target_entropy": float | Auto,
            "delay_qvalue": bool,
            "skip_done_states": bool,
            "deactivate_vmap": bool,
            "use_prioritized_weights": Weights,
        },
    ),
    "torchrl.objectives.ppo.ClipPPOLoss": TorchRLLoss(
        "present",
        {
            **WITH_ENTROPY,
            "clip_epsilon": Ratio | tuple[Positive, Positive],
            "normalize_advantage": bool,
            "log_explained_variance": bool,
            "clip_value": bool | Positive | None,
            "max_importance_ratio": Positive | None,
        },
    ),
    "torchrl.objectives.a2c.A2CLoss": TorchRLLoss("present", {**WITH_ENTROPY, "clip_value": Positive | None}),
    "torchrl.objectives.reinforce.ReinforceLoss": TorchRLLoss("present", {**ADVANTAGES, "clip_value": Positive | None}),
}
"""By the full names of the classes; those derived from them serve, too."""

INSTEAD: Mapping[str, str] = {
    "torchrl.objectives.sac.SACLoss": "DiscreteSACLoss, or nfv_torchrl.losses.DiscreteSAC",
    "torchrl.objectives.cql.CQLLoss": "DiscreteCQLLoss, or nfv_torchrl.losses.CQL",
    "torchrl.objectives.iql.IQLLoss": "DiscreteIQLLoss",
    "torchrl.objectives.ppo.KLPENPPOLoss": "ClipPPOLoss, or nfv_torchrl.losses.PPO",
    "torchrl.objectives.ppo.PPOLoss": "ClipPPOLoss, or nfv_torchrl.losses.PPO",
}
"""What serves in place of a class that does not."""

RECIPES = {"memory": "recipes/dqn.py or recipes/offline.py", "present": "recipes/policy_gradient.py"}
GIVEN = ("network", "sizes")
OURS = ("gamma", "lmbda", "stop_at", "atoms", "v_min", "v_max")
"""Settings that TorchRL has elsewhere than in the constructor of the loss."""
MANY = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


class LossTarget(Target):
    """A ``RequestLoss`` by ``_target_``, or a class of TorchRL's; see ``Target``.

    Args:
        learns_from: what the recipe has for TorchRL's classes, see ``TorchRLLoss``.
    """

    def __init__(self, learns_from: Literal["memory", "present"]) -> None:
        super().__init__(*GIVEN, has=("prepare", "forward"))
        self.learns_from = learns_from

    def check(self, value: Any, where: str, expected: str) -> None:
        """See ``Rule``."""
        kind = locate(value.get("_target_"), where)
        base = served(kind)
        if base is None:
            super().check(value, where, expected)
            return
        if base.learns_from != self.learns_from:
            has = {"memory": "a replay memory", "present": "what its own policy has just done"}[base.learns_from]
            raise ScenarioError(f"{where}._target_: {kind.__name__} learns from {has}; use {RECIPES[base.learns_from]}")
        check_settings(kind, {key: item for key, item in value.items() if key != "_target_"}, where)


def served(kind: Any) -> TorchRLLoss | None:
    """How the TorchRL class ``kind``, or the one that it derives from, serves; None for anything else.

    A class that has ``prepare`` is a ``RequestLoss`` by itself, whatever it derives from.

    Raises:
        ScenarioError: a loss class of TorchRL's that does not serve here.
    """
    names = _names(kind)
    if LOSS_MODULE not in names or hasattr(kind, "prepare"):
        return None
    found = next((SERVED[name] for name in names if name in SERVED), None)
    if found is None and names[0].startswith("torchrl."):
        known = ", ".join(name.rpartition(".")[2] for name in SERVED)
        instead = INSTEAD.get(names[0], f"one of {known}")
        raise ScenarioError(
            f"loss._target_: {names[0]} does not serve here, where actions are numbered and few of them valid; use "
            f"{instead}, or a class of your own with 'prepare'"
        )
    return found


def check_settings(kind: type, settings: Mapping[str, Any], where: str = "loss") -> dict[str, Any]:
    """The settings of a TorchRL class, or of one derived from it, each as its kind.

    Raises:
        ScenarioError: a name that cannot be set, or a value of another kind.
    """
    kinds = kinds_of(kind)
    for key in settings:
        if key not in kinds:
            refuse_key(join(where, key), kinds)
    return {key: parse(value, kinds[key], join(where, key)) for key, value in settings.items()}


def kinds_of(kind: type) -> dict[str, Any]:
    """What may be set of ``kind``, by name: of TorchRL's settings those that it takes, and the new ones of its own."""
    names = _names(kind)
    base = next(place for place, name in enumerate(names) if name in SERVED)
    theirs, own = _parameters(kind.__mro__[base]), _parameters(kind)
    taken = {key: hint for key, hint in SERVED[names[base]].settings.items() if key in own or key in OURS}
    return taken | {key: hint for key, hint in own.items() if key not in theirs}


def names_of(target: Any) -> set[str] | None:
    """The settings that a loss class or function takes; None: any."""
    if served(target) is not None:
        return set(kinds_of(target))
    parameters = inspect.signature(target).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return {parameter.name for parameter in parameters}


def forget_other_loss(config: DictConfig, overrides: Sequence[str]) -> None:
    """Where a command line names another class of loss, leave out what its yaml file says to the class before.

    ``recipes/dqn.py preset=mlp loss._target_=torchrl.objectives.DQNLoss`` begins with ``loss/double_dqn.yaml``, whose
    ``double`` is none of the new class's settings. What both have stays, and so does what the command line sets itself,
    so that a mistake there is still refused.

    Args:
        config: of a recipe, changed in place.
        overrides: of the command line.
    """
    given = [match[1] for match in (re.match(r"\+{0,2}loss\.(\w+)[\w.]*=", text) for text in overrides) if match]
    if "_target_" not in given:
        return
    try:
        known = names_of(locate(config.loss.get("_target_"), "loss"))
    except (ScenarioError, ValueError):  # it is checked with all other settings, and refused there
        return
    kept = {*config.loss} if known is None else {*known, *given, *OF_HYDRA}
    with open_dict(config):
        for key in {*config.loss} - kept:
            del config.loss[key]


def _names(kind: Any) -> list[str]:
    return [f"{each.__module__}.{each.__qualname__}" for each in kind.__mro__] if inspect.isclass(kind) else []


def _parameters(kind: type) -> dict[str, Any]:
    """What the constructor takes by name, with kinds that can be judged; what it hands on by ``**`` included."""
    found: dict[str, Any] = {}
    for each in kind.__mro__:
        if "__init__" not in vars(each):
            continue
        constructor = vars(each)["__init__"]
        parameters = inspect.signature(constructor).parameters
        hints = written_hints(constructor)
        named = [name for name, parameter in parameters.items() if parameter.kind not in MANY]
        found = {name: hints.get(name, Any) for name in named[1:]} | found
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
            break
    return found
