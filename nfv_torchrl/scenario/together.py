"""Several draws of one scenario whose requests bring profiles of their own, held together.

Where a file holds the laws of its requests, every scenario seed draws other requests, with other profiles. A simulator
has one table of profiles, so what is simulated together needs the profiles of all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.profiles import join_profiles
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.workload import Workload


def share_profiles(scenarios: Sequence[Scenario]) -> list[Scenario]:
    """The same scenarios with one table of profiles, that of all, and the horizon of the longest.

    Args:
        scenarios: with requests from a file each, of one catalogue.

    Raises:
        ScenarioError: requests that are not from a file, or bring no profiles.
    """
    requests = [scenario.file_workload for scenario in scenarios]
    parts = [each.own for each in requests if each.own is not None]
    if len(parts) < len(requests):
        raise ScenarioError("share_profiles: requests without profiles of their own need no table that is shared")
    own, services = join_profiles(parts), len(scenarios[0].catalogue.types)
    horizon = max(scenario.horizon for scenario in scenarios)
    shared, offset, table = [], 0, None
    for scenario, each, part in zip(scenarios, requests, parts, strict=True):
        other = scenario.replace(horizon=horizon)
        profile = np.where(each.profile >= services, each.profile + offset, each.profile)
        vars(other)["file_workload"] = dataclasses.replace(each, profile=profile, own=own)
        table = other.profiles if table is None else table
        vars(other)["profiles"] = table
        shared.append(other)
        offset += len(part)
    return shared


def play_apart(scenarios: Sequence[Scenario]) -> bool:
    """Whether scenarios are played one after the other: requests from a file may bring demands of their own, which
    differ from scenario to scenario, and a simulator of all would hold the tables of all."""
    return len(scenarios) > 1 and any(scenario.workload_path is not None for scenario in scenarios)


def fit_one_batch(scenarios: Sequence[Scenario]) -> list[Scenario]:
    """The scenarios as they are if they ask for the same profiles, else with those of all."""
    first = scenarios[0].profiles
    return list(scenarios) if all(each.profiles.same_as(first) for each in scenarios) else share_profiles(scenarios)


class PooledScenario(Scenario):
    """A scenario each of whose horizons has the requests of one of several draws, chosen by the workload seed.

    Make it by ``of``.
    """

    pool: tuple[Workload, ...] = ()

    @classmethod
    def of(cls, scenarios: Sequence[Scenario]) -> PooledScenario:
        """The first of ``scenarios``, with the requests of all of them; see ``share_profiles``."""
        return cls.several(scenarios, 1)[0]

    @classmethod
    def several(cls, scenarios: Sequence[Scenario], count: int) -> list[PooledScenario]:
        """The first ``count`` of ``scenarios``, each with the requests of all of them, which have to fit its network;
        see ``share_profiles``."""
        shared = share_profiles(scenarios)
        requests = tuple(scenario.file_workload for scenario in shared)
        longest, profiles = max(requests, key=len), shared[0].profiles
        made = []
        for scenario in shared[:count]:
            pooled = cls(**{field.name: getattr(scenario, field.name) for field in dataclasses.fields(Scenario)})
            # As what a scenario reads from files: no attribute that a config has.
            vars(pooled).update(pool=requests, profiles=profiles, file_workload=longest)
            made.append(pooled)
        return made

    def replace(self, **changes: Any) -> PooledScenario:
        """See ``Scenario``; the requests are the same."""
        other = super().replace(**changes)
        vars(other)["pool"] = self.pool
        return cast(PooledScenario, other)

    def workload(self, seed: int, *key: int) -> Workload:
        """The requests of one of the draws, always the same for the same arguments."""
        return self.pool[int(generator(seed, Stream.WORKLOAD, *key).integers(len(self.pool)))]
