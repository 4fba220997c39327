"""The settings of every recipe: one dataclass each, checked before anything is made or moved.

A group such as ``loss`` or ``method`` names its class by ``_target_``; its arguments are checked against the signature
of that class. Everything else is a key with a type.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import parse_config
from nfv_torchrl.settings.targets import Target
from nfv_torchrl.settings.torchrl_losses import LossTarget, forget_other_loss
from nfv_torchrl.settings.values import (
    Bounds,
    Count,
    Exact,
    LearningRate,
    Natural,
    NotEmpty,
    NotNegative,
    OneOf,
    Positive,
    Rule,
    Seed,
    SeedList,
    Tasks,
    Threads,
    parse_dataclass,
)

Settings = TypeVar("Settings")


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


@dataclass(frozen=True)
class Logger:
    """``interval``: iterations or updates from one log line to the next; ``references``: compare with rules."""

    interval: Count
    figures: bool
    references: bool


@dataclass(frozen=True)
class HeldOut:
    """Evaluations during a training; ``interval`` 0: never."""

    interval: Natural
    seeds: SeedList


@dataclass(frozen=True)
class DqnHeldOut(HeldOut):
    """Also ``count`` random ``networks`` on which the best policy is chosen; null: it is chosen on the scenario's."""

    networks: Networks | None
    count: Count


@dataclass(frozen=True)
class Saving:
    """Checkpoints; ``keep``: how many of the newest stay."""

    interval: Count
    keep: Count


@dataclass(frozen=True)
class Run:
    """What every training has."""

    scenario: ScenarioKeys
    run_dir: str
    resume: bool
    seed: Seed


@dataclass(frozen=True)
class ReplayParts:
    """What a replay memory is made of; ``beta``: the sampler's exponent of importance weights by frames."""

    storage: Storage
    sampler: Sampler
    writer: Writer
    beta: Exploration | None


@dataclass(frozen=True)
class Buffer(ReplayParts):
    """The replay memory, in transitions or sequences."""

    size: Count
    batch_size: Count
    warmup_frames: Natural


@dataclass(frozen=True)
class Learner:
    """The learner of ``dqn``."""

    updates: Count
    lr: LearningRate
    max_grad_norm: Positive | None
    compile: bool
    lr_end: LearningRate | None


@dataclass(frozen=True)
class DqnSettings(Run):
    """See ``config/dqn.yaml``."""

    env: Decisions
    network: Network
    loss: ReplayLoss
    reward: Reward
    exploration: Exploration
    networks: Networks | None
    target: Updater
    init_from: str | None
    device: str
    threads: Threads
    env_threads: Threads
    one_hot: bool
    stagger: bool
    segment: Count | None
    collector: Collector
    buffer: Buffer
    learner: Learner
    logger: Logger
    eval: DqnHeldOut
    saving: Saving

    def __post_init__(self) -> None:
        check_segment(self.segment, self.stagger)
        if self.buffer.batch_size > self.buffer.size:
            raise ScenarioError(
                f"buffer.batch_size: {self.buffer.batch_size} is more than the memory holds; use buffer.size="
                f"{self.buffer.size} at most, or a larger memory"
            )
        num_envs, steps = self.collector["num_envs"], self.collector["steps"]
        if num_envs > self.buffer.size:
            raise ScenarioError(
                f"buffer.size: {self.buffer.size} where each batch brings at least {num_envs} rows "
                "(collector.num_envs); use a larger memory"
            )
        burn_in = self.loss.get("burn_in", 0)
        if burn_in >= steps:
            raise ScenarioError(
                f"loss.burn_in: {burn_in} steps of sequences that have {steps}; use less, or more collector.steps"
            )


@dataclass(frozen=True)
class BatchLearner:
    """The learner of ``policy_gradient``."""

    epochs: Count
    minibatch: Count
    lr: LearningRate
    max_grad_norm: Positive | None


@dataclass(frozen=True)
class PolicyGradientSettings(Run):
    """See ``config/policy_gradient.yaml``."""

    env: Decisions
    network: Network
    loss: OnPolicyLoss
    reward: Reward
    device: str
    threads: Threads
    env_threads: Threads
    one_hot: bool
    stagger: bool
    segment: Count | None
    collector: Collector
    learner: BatchLearner
    logger: Logger
    eval: HeldOut
    saving: Saving

    def __post_init__(self) -> None:
        check_segment(self.segment, self.stagger)


@dataclass(frozen=True)
class Recording:
    """What ``offline`` records before it learns."""

    num_envs: Count
    steps: Count
    frames: Count
    seed: Seed


@dataclass(frozen=True)
class OfflineLearner:
    """The learner of ``offline``."""

    updates: Count
    batch_size: Count
    lr: LearningRate
    max_grad_norm: Positive | None
    compile: bool


@dataclass(frozen=True)
class OfflineSettings(Run):
    """See ``config/offline.yaml``."""

    method: Methods
    network: Network
    loss: ReplayLoss
    reward: Reward
    target: Updater
    device: str
    threads: Threads
    one_hot: bool
    stagger: bool
    checkpoint: str | None
    dataset: str | None
    record: Recording
    buffer: ReplayParts
    learner: OfflineLearner
    logger: Logger
    eval: HeldOut
    saving: Saving

    def __post_init__(self) -> None:
        check_checkpoint(self.checkpoint, self.method)


@dataclass(frozen=True)
class Search:
    """CMA-ES; ``population`` null: its default."""

    sigma: Positive
    population: Annotated[int, Exact(), Bounds(at_least=2, at_most=10**6)] | None
    diagonal: bool


@dataclass(frozen=True)
class Fitness:
    """Weights of the fitness, see ``nfv_torchrl.evolution.fitness.Arena``."""

    cost_weight: NotNegative
    saving_weight: NotNegative
    spread: Positive


@dataclass(frozen=True)
class Generation:
    """``tasks``: horizons that every candidate plays."""

    tasks: Tasks


@dataclass(frozen=True)
class HeldOutTasks:
    """Evaluations of an evolution; ``interval`` 0: never."""

    interval: Natural
    seed: Seed
    tasks: Tasks


@dataclass(frozen=True)
class Board:
    """``figures``: draw the network at each evaluation; ``references``: compare with rules."""

    figures: bool
    references: bool


@dataclass(frozen=True)
class EvolutionSettings(Run):
    """See ``config/evolution.yaml``."""

    network: Network
    tasks: Annotated[Mapped, Target("scenario")]
    policy: Evolved
    strategy: Search
    parallel: Parallel
    generations: Count
    init_from: str | None
    generation: Generation
    fitness: Fitness
    eval: HeldOutTasks
    logger: Board
    saving: Saving


@dataclass(frozen=True)
class EvaluateSettings:
    """See ``config/evaluate.yaml``."""

    scenario: ScenarioKeys
    method: Methods
    checkpoint: str | None
    seeds: SeedList
    scenario_seeds: SeedList | None
    output: str | None
    reference: str | None
    bounds: bool
    audit: bool
    threads: Threads
    parallel: Parallel

    def __post_init__(self) -> None:
        check_checkpoint(self.checkpoint, self.method)


@dataclass(frozen=True)
class TransferSettings:
    """See ``config/transfer.yaml``."""

    checkpoint: str | None
    checkpoints: tuple[str, ...] | None
    method: Methods
    networks: dict[str, Overrides]
    only: Overrides | None
    rho: tuple[Positive, ...] | None
    draws: bool
    overrides: Overrides
    seeds: Count
    bounds: bool
    parallel: Parallel
    output: str

    def __post_init__(self) -> None:
        check_is_read(self.checkpoints or self.checkpoint, self.method)


@dataclass(frozen=True)
class NetworkAtLoads:
    """A network of ``field``: overrides of evaluate.py, in which LOAD stands for each of ``loads``."""

    loads: Annotated[tuple[Positive, ...], Some]
    overrides: Overrides


@dataclass(frozen=True)
class FieldSettings:
    """See ``config/field.yaml``."""

    method: Methods
    parallel: Parallel
    title: str
    axis: str
    common: Overrides
    draws: bool
    places: dict[str, NetworkAtLoads]
    published: tuple[dict[str, Any], ...]
    checkpoint: str | None
    checkpoints: tuple[str, ...] | None
    seeds: Count
    bounds: bool
    labels: Count | None
    data: str | None
    reference: str
    only: Overrides | None
    overrides: Overrides
    freeze: str | None
    output: str

    def __post_init__(self) -> None:
        check_is_read(self.checkpoints or self.checkpoint, self.method)


@dataclass(frozen=True)
class Load:
    """lambda and mu."""

    arrival_rate: Positive
    mean_lifetime: Positive


@dataclass(frozen=True)
class TrainedPoints:
    """Where agents are trained; null: everywhere."""

    nodes: tuple[Nodes, ...] | None
    arrival_rate: tuple[Positive, ...] | None
    mean_lifetime: tuple[Positive, ...] | None


@dataclass(frozen=True)
class Timing:
    """Workloads and slots that decision times are measured on."""

    seeds: Count
    horizon: Count


@dataclass(frozen=True)
class Budget:
    """See ``config/budget``."""

    name: str
    seeds: Count
    training_seeds: Count
    nodes: Annotated[tuple[Nodes, ...], Some]
    nodes_at: Load
    arrival_rates: Annotated[tuple[Positive, ...], Some]
    mean_lifetimes: Annotated[tuple[Positive, ...], Some]
    cost_weights: Annotated[tuple[NotNegative, ...], Some]
    trained_colocation: tuple[bool, ...]
    trained_points: TrainedPoints
    timing: Timing
    frames: dict[str, Count]
    explore_frames: Count
    target_interval: Count
    eval_interval: dict[str, Natural]


@dataclass(frozen=True)
class Once:
    """What the scenario of the one training has of its own; null: that of the figures."""

    arrival_rate: Positive | None = None
    mean_lifetime: Positive | None = None


@dataclass(frozen=True)
class TrainedMethod:
    """A method of the figures that is trained first."""

    recipe: str
    policy: str
    overrides: Overrides
    method: Annotated[Mapped, Target("path", "name", "scenario", partial=True)]
    once: Once | None = None


@dataclass(frozen=True)
class RewardCurve:
    """A reward that the figures compare."""

    label: str
    overrides: Overrides
    w_cost: NotNegative


@dataclass(frozen=True)
class FiguresSettings:
    """See ``config/figures.yaml``."""

    scenario: ScenarioKeys
    method: Methods
    budget: Budget
    figure: str | Overrides
    output: str
    parallel: Parallel
    colocation: Colocations
    trained: dict[str, TrainedMethod]
    rewards: dict[str, RewardCurve]


@dataclass(frozen=True)
class NamedTraining:
    """One entry of ``losses`` or ``methods``: what is trained under that name."""

    overrides: Overrides
    recipe: str = "dqn"


@dataclass(frozen=True)
class CompareLossesSettings:
    """See ``config/compare_losses.yaml``."""

    scenario: ScenarioKeys
    frames: Count
    explored: Count
    seeds: Count
    workloads: Count
    eval_seeds: SeedList
    reference: str
    only: Overrides | None
    parallel: Parallel
    method: Methods
    compute: bool
    output: str
    overrides: Overrides
    settings: dict[str, Overrides]
    losses: dict[str, NamedTraining]
    figures: dict[str, Overrides]


@dataclass(frozen=True)
class MaskablePPO:
    """How sb3-contrib's MaskablePPO is trained; what is not named is as it comes."""

    frames: Count
    evaluations: Count
    num_envs: Count
    steps: Count
    batch_size: Count


@dataclass(frozen=True)
class TimeToQualitySettings:
    """See ``config/time_to_quality.yaml``."""

    scenario: ScenarioKeys
    shares: Annotated[tuple[Positive, ...], Some]
    seeds: Count
    workloads: SeedList
    only: Overrides | None
    compute: bool
    output: str
    overrides: Overrides
    settings: dict[str, Overrides]
    methods: dict[str, NamedTraining]
    maskable_ppo: MaskablePPO


@dataclass(frozen=True)
class TrainingSpeed:
    """How training is measured."""

    frames: Count
    overrides: Overrides


@dataclass(frozen=True)
class MethodSpeed:
    """How decisions are measured."""

    batch_size: Count
    seconds: Positive


@dataclass(frozen=True)
class MemoryUse:
    """A batch that has to fit; what is left out is as in the scenario."""

    nodes: Nodes
    batch_size: Count
    arrival_rate: Positive | None = None
    mean_lifetime: Positive | None = None
    horizon: Count | None = None


@dataclass(frozen=True)
class BenchmarkSettings:
    """See ``config/benchmark.yaml``."""

    scenario: ScenarioKeys
    method: Methods
    parts: tuple[
        Annotated[
            str,
            OneOf(
                "kernel", "env", "collector", "workers", "rows", "gym", "training", "methods", "evaluation", "memory"
            ),
        ],
        ...,
    ]
    nodes: Annotated[tuple[Nodes, ...], Some]
    batch_sizes: Annotated[tuple[Count, ...], Some]
    arrivals_per_node: Positive | None
    loaded_slot: Natural
    repeats: Count
    frames: Count
    memory_limit: Positive
    output: str | None
    training: TrainingSpeed
    methods: MethodSpeed
    memory: tuple[MemoryUse, ...]


@dataclass(frozen=True)
class TunePricedSettings:
    """See ``config/tune_priced.yaml``."""

    scenario: ScenarioKeys
    loads: Annotated[tuple[Load, ...], Some]
    colocation: Colocations
    scenario_seeds: Annotated[tuple[Seed, ...], Some]
    seeds: Count
    prices: Annotated[tuple[NotNegative, ...], Some]
    steepness: Annotated[tuple[Annotated[float, Bounds(above=1)], ...], Some]
    thresholds: Annotated[tuple[NotNegative | None, ...], Some]
    output: str | None
    parallel: Parallel


@dataclass(frozen=True)
class MilpGapSettings:
    """The options of ``milp_gap.py``."""

    seeds: Count
    requests: Count


RECIPES: dict[str, type] = {
    "benchmark": BenchmarkSettings,
    "compare_losses": CompareLossesSettings,
    "dqn": DqnSettings,
    "evaluate": EvaluateSettings,
    "evolution": EvolutionSettings,
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


def check_checkpoint(checkpoint: str | None, method: Mapping[str, Any]) -> None:
    """``method=checkpoint`` needs ``checkpoint=PATH``, and the other way round.

    Raises:
        ScenarioError: one is there without the other.
    """
    if checkpoint is None and "checkpoint" in method:
        raise ScenarioError("checkpoint: is null; method=checkpoint needs a file, such as checkpoint=runs/dqn/best.pt")
    check_is_read(checkpoint, method)


def check_is_read(checkpoint: str | Sequence[str] | None, method: Mapping[str, Any]) -> None:
    """``checkpoint=PATH``, or ``checkpoints=[...]``, needs ``method=checkpoint``.

    Raises:
        ScenarioError: no method would read the files.
    """
    if checkpoint is not None and "checkpoint" not in method:
        named = checkpoint if isinstance(checkpoint, str) else ", ".join(checkpoint)
        raise ScenarioError(f"checkpoint: {named} would not be read; add it to the methods: method=[greedy,checkpoint]")


def check_segment(segment: int | None, stagger: bool) -> None:
    """``segment`` is about staggered environments.

    Raises:
        ScenarioError: there is a segment without them.
    """
    if segment is not None and not stagger:
        raise ScenarioError(f"segment: {segment} slots need staggered environments; set stagger=true, or segment=null")


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
