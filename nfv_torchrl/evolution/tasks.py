"""What a generation is measured on: a network and the requests of one horizon, the same for every candidate."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import parse_config
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.together import PooledScenario, share_profiles
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.settings.values import Count

FIRST_SCENARIO_SEED = 1_000_000
"""Networks drawn here have scenario seeds from this on, so they are never those of an evaluation (0, 1, ...)."""


@dataclass(frozen=True)
class Task:
    """One horizon: a scenario with the requests and failures that every candidate meets."""

    scenario: Scenario
    workload: Workload
    timeline: FailureTimeline

    @classmethod
    def of(cls, scenario: Scenario, seed: int, *key: int) -> Task:
        """The horizon of workload seed ``seed``. ``key`` splits the seed further; evaluations use none."""
        return cls(scenario, scenario.workload(seed, *key), scenario.failure_timeline(seed, *key))


class FixedNetwork:
    """The network of one scenario, with requests of its own in every generation.

    Args:
        scenario: the recipe's scenario config.
    """

    def __init__(self, scenario: Mapping[str, Any]) -> None:
        self.scenario = Scenario.from_config(scenario)

    def draw(self, seed: int, generation: int, count: int) -> list[Task]:
        """``count`` tasks, always the same for the same arguments."""
        return [Task.of(self.scenario, seed, generation, k) for k in range(count)]


class Redrawn:
    """The scenario drawn anew with other seeds: for scenarios whose requests follow from their seed (a file of laws).

    Args:
        scenario: the recipe's scenario config.
        draws: what one training goes through, each horizon one of them.
        workloads: files of requests or of their laws, for the draws in turn, such as those of several loads; None: the
            scenario's own.
        substrates: networks of so many of the draws, the first ones, that the environments of a batch live on in turn.

    Raises:
        ScenarioError: no draw, an empty list of files, or no network or more than draws.
    """

    def __init__(
        self,
        scenario: Mapping[str, Any],
        *,
        draws: int = 32,
        workloads: Sequence[str] | None = None,
        substrates: Count = 1,
    ) -> None:
        if draws < 1:
            raise ScenarioError(f"networks.draws: {draws}; use at least 1")
        if not 1 <= substrates <= draws:
            raise ScenarioError(f"networks.substrates: {substrates}; use 1 to networks.draws, {draws}")
        if workloads is not None and not workloads:
            raise ScenarioError("workloads: is empty; name at least one file, or null for the scenario's own")
        self.draws, self.substrates = draws, substrates
        own = dict(scenario.get("workload") or {})
        of_files = [{**scenario, "workload": {**own, "path": path}} for path in workloads or ()]
        self.bases = of_files or [dict(scenario)]

    def draw(self, seed: int, generation: int, count: int) -> list[Task]:
        """``count`` tasks, always the same for the same arguments."""
        scenarios = share_profiles(self._drawn(seed, generation, count))
        return [Task.of(scenario, seed, generation, k) for k, scenario in enumerate(scenarios)]

    def scenarios(self, seed: int, count: int) -> list[Scenario]:
        """The scenarios that the ``count`` environments of a batch train on in turn: each with the network of one of
        the draws, and the requests of all."""
        return list(PooledScenario.several(self._drawn(seed, 0, self.draws), min(self.substrates, count)))

    def _drawn(self, seed: int, generation: int, count: int) -> list[Scenario]:
        numbers = [generator(seed, Stream.NETWORKS, generation, k) for k in range(count)]
        seeds = [int(rng.integers(FIRST_SCENARIO_SEED, 2**31)) for rng in numbers]
        bases = itertools.cycle(self.bases)
        return [Scenario.from_config({**base, "seed": number}) for base, number in zip(bases, seeds, strict=False)]


class RandomNetworks:
    """Every task on a random network of its own: size, degree, VMs a node and offered load are drawn.

    Args:
        scenario: the recipe's scenario config, for everything else.
        nodes: [low, high], N, log-uniform.
        mean_degree: [low, high], uniform.
        vms_max: [low, high], integer uniform.
        rho: [low, high], offered load, log-uniform; VM capacities are scaled to it.
        arrival_rate: values of lambda to choose from.
        colocation: values to go through in turn, such as ``[false, true]``.
        observe_lifetime: the same, for every round of ``colocation``; None: as the scenario says.
        horizon: values of T to choose from.

    Raises:
        ScenarioError: an empty range or list.
    """

    def __init__(
        self,
        scenario: Mapping[str, Any],
        *,
        nodes: Sequence[int] = (10, 50),
        mean_degree: Sequence[float] = (3.0, 5.0),
        vms_max: Sequence[int] = (2, 6),
        rho: Sequence[float] = (0.3, 3.0),
        arrival_rate: Sequence[float] = (10.0, 25.0),
        colocation: Sequence[bool] = (False, True),
        observe_lifetime: Sequence[bool] | None = None,
        horizon: Sequence[int] = (1000,),
    ) -> None:
        shown = [parse_config(scenario).observe_lifetime] if observe_lifetime is None else observe_lifetime
        for name, ends in (("nodes", nodes), ("mean_degree", mean_degree), ("vms_max", vms_max), ("rho", rho)):
            if len(ends) != 2 or not 0 < ends[0] <= ends[1]:
                raise ScenarioError(f"tasks.{name}: {list(ends)}; give [low, high] with 0 < low <= high")
        choices = (("arrival_rate", arrival_rate), ("colocation", colocation), ("observe_lifetime", shown),
                   ("horizon", horizon))  # fmt: skip
        for name, values in choices:
            if not len(values):
                raise ScenarioError(f"tasks.{name}: is empty; give at least one value")
        self.base = dict(scenario)
        self.nodes, self.mean_degree, self.vms_max, self.rho = nodes, mean_degree, vms_max, rho
        self.arrival_rate, self.horizon = arrival_rate, horizon
        self.colocation, self.observe_lifetime = colocation, shown

    def draw(self, seed: int, generation: int, count: int) -> list[Task]:
        """``count`` tasks, always the same for the same arguments."""
        return [
            Task.of(self._scenario(seed, generation, k, generation * count + k), seed, generation, k)
            for k in range(count)
        ]

    def scenarios(self, seed: int, count: int) -> list[Scenario]:
        """``count`` networks to train on step by step, one for each environment of a batch."""
        return [self._scenario(seed, 0, k, k) for k in range(count)]

    def _scenario(self, seed: int, generation: int, k: int, turn: int) -> Scenario:
        rng = generator(seed, Stream.NETWORKS, generation, k)
        nodes = round(_log_uniform(rng, *self.nodes))
        substrate = {
            **self.base.get("substrate", {}),
            "nodes": nodes,
            "mean_degree": float(rng.uniform(self.mean_degree[0], self.mean_degree[1])),
            "vms_max": int(rng.integers(self.vms_max[0], self.vms_max[1], endpoint=True)),
            "target_rho": _log_uniform(rng, *self.rho),
        }
        config = {
            **self.base,
            "name": f"random_{generation}_{k}",
            "seed": int(rng.integers(FIRST_SCENARIO_SEED, 2**31)),
            "arrival_rate": float(rng.choice(self.arrival_rate)),
            "horizon": int(rng.choice(self.horizon)),
            "colocation": bool(self.colocation[turn % len(self.colocation)]),
            "observe_lifetime": bool(self.observe_lifetime[turn // len(self.colocation) % len(self.observe_lifetime)]),
            "substrate": substrate,
        }
        return Scenario.from_config(config)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
