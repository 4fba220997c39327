"""The settings of recipes that train."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.checkpoints import check_checkpoint
from nfv_torchrl.settings.kinds import (
    Collector,
    Decisions,
    Evolved,
    Exploration,
    Mapped,
    Methods,
    Network,
    Networks,
    OnPolicyLoss,
    Parallel,
    ReplayLoss,
    Reward,
    Sampler,
    ScenarioKeys,
    Storage,
    Updater,
    Writer,
)
from nfv_torchrl.settings.targets import Target
from nfv_torchrl.settings.values import (
    Bounds,
    Count,
    Exact,
    LearningRate,
    Natural,
    NotNegative,
    Positive,
    Seed,
    SeedList,
    Tasks,
    Threads,
)


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
    bound: bool


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


def check_segment(segment: int | None, stagger: bool) -> None:
    """``segment`` is about staggered environments.

    Raises:
        ScenarioError: there is a segment without them.
    """
    if segment is not None and not stagger:
        raise ScenarioError(f"segment: {segment} slots need staggered environments; set stagger=true, or segment=null")
