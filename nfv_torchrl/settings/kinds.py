"""The kinds of keys that settings of recipes are made of."""

from __future__ import annotations

from typing import Annotated, Any

from nfv_torchrl.scenario.config import parse_config
from nfv_torchrl.settings.targets import Target
from nfv_torchrl.settings.torchrl_losses import LossTarget
from nfv_torchrl.settings.values import Bounds, Exact, NotEmpty, Rule


class ScenarioRule(Rule):
    """The keys of a scenario."""

    def check(self, value: Any, where: str, expected: str) -> None:
        """See ``Rule``."""
        parse_config(value)


Mapped = dict[str, Any]
ScenarioKeys = Annotated[Mapped, ScenarioRule()]
Network = Annotated[Mapped, Target("sizes", "outputs", partial=True)]
PlainNetwork = Annotated[Mapped, Target("sizes", "outputs", partial=None)]
ReplayLoss = Annotated[Mapped, LossTarget("memory")]
OnPolicyLoss = Annotated[Mapped, LossTarget("present")]
Evolved = Annotated[Mapped, Target("network", "sizes")]
Reward = Annotated[Mapped, Target("outcome", "scale", partial="functions")]
Decisions = Annotated[Mapped, Target()]
Exploration = Annotated[Mapped, Target("frames", partial=True)]
Updater = Annotated[Mapped, Target("loss_module", partial=True)]
Networks = Annotated[Mapped, Target("scenario", partial=True)]
Collector = Annotated[Mapped, Target(has=("prepare", "start"))]
Storage = Annotated[Mapped, Target("max_size", has=("get", "set"))]
Sampler = Annotated[Mapped, Target("max_capacity", has=("sample", "state_dict"))]
Writer = Annotated[Mapped, Target(has=("extend", "state_dict"))]
Methods = dict[str, Annotated[Mapped, Target("scenario", partial=None)]]
Parallel = Annotated[Mapped, Target(has=("unordered", "map"))]
Overrides = tuple[str, ...]
Nodes = Annotated[int, Exact(), Bounds(at_least=2)]
Some = NotEmpty()
Colocations = Annotated[tuple[bool, ...], Some]
