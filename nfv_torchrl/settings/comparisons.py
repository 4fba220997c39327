"""The settings of recipes that compare and measure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from nfv_torchrl.settings.checkpoints import check_checkpoint, check_is_read
from nfv_torchrl.settings.kinds import Colocations, Mapped, Methods, Nodes, Overrides, Parallel, ScenarioKeys, Some
from nfv_torchrl.settings.targets import Target
from nfv_torchrl.settings.values import Bounds, Count, Natural, NotNegative, OneOf, Positive, Seed, SeedList, Threads


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

    preset: str
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
