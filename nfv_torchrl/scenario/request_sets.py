"""Requests of other projects' files as those of a scenario: Virne's folders, CN-UPB/NFVdeep's ``requests.json``."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.files import load_json
from nfv_torchrl.scenario.demands import Demand, to_profiles
from nfv_torchrl.scenario.formats.nfvdeep import drawn_stay, read_nfvdeep
from nfv_torchrl.scenario.formats.requests import Asked, RequestSet
from nfv_torchrl.scenario.formats.virne import read_virne
from nfv_torchrl.scenario.formats.virne_laws import ChainLaws, draw_asked, read_laws
from nfv_torchrl.scenario.profiles import MOST_FUNCTIONS
from nfv_torchrl.scenario.quoting import shown
from nfv_torchrl.scenario.request_file import Columns, slots_of
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY

LAWS = (".yaml", ".yml")
"""Suffixes of Virne's settings, which hold the laws of requests."""
NONE_OF_OURS = (
    "its requests name no service, so the scenario must have one only, whose name they take; use scenario=virne, or "
    "list one service"
)


def is_request_set(path: Path) -> bool:
    """Whether ``path`` is a folder or a JSON or YAML file, so no CSV file of this project."""
    return path.is_dir() or path.suffix.lower() in (".json", *LAWS)


def holds_laws(path: str | os.PathLike[str]) -> bool:
    """Whether a workload file holds the laws of requests, which are drawn anew with each scenario seed."""
    suffix = Path(path).suffix.lower()
    return suffix in LAWS or (suffix == ".json" and isinstance(load_json(path), Mapping))


def mean_stay(path: str | os.PathLike[str], seed: int) -> float | None:
    """Mean of the exponential law from which a file of laws has lifetimes drawn with ``seed``, s; None: no such file.

    Lifetimes are exponential, or as many whole slots as an exponential one is in. The probability that one is longer
    than k whole slots is exp(-k / mean) in either case.

    Raises:
        ScenarioError: the file cannot be read.
    """
    if not holds_laws(path):
        return None
    return read_laws(Path(path)).mean_lifetime if Path(path).suffix.lower() in LAWS else drawn_stay(Path(path), seed)


def read_request_set(path: Path, catalogue: ServiceCatalogue, horizon: int | None, seed: int) -> Columns:
    """The requests of Virne's folders or settings, or of CN-UPB/NFVdeep's JSON, a profile each, both ends free.

    Args:
        path: folder or file.
        catalogue: its only service is that of all requests, its kinds of resources are those they are read for.
        horizon: arrivals are below it; None: there is no limit.
        seed: scenario seed, which requests are drawn with where a file holds their laws.

    Raises:
        ScenarioError: it cannot be used; the message names the request.
    """
    if len(catalogue.types) != 1:
        raise ScenarioError(f"{path}: {NONE_OF_OURS} (there are {len(catalogue.types)} services)")
    kinds = [kind.name for kind in catalogue.resources]
    if path.suffix.lower() in LAWS:
        found = RequestSet(str(path), draw_asked(read_laws(path), generator(seed, Stream.REQUESTS), str(path)))
    else:
        found = read_virne(path, kinds) if path.is_dir() else read_nfvdeep(path, seed)
    return _columns(found, catalogue, horizon)


def chain_columns(laws: ChainLaws, catalogue: ServiceCatalogue, rng: np.random.Generator) -> Columns:
    """Requests drawn from ``laws``, as ``read_request_set`` has those of a file."""
    return _columns(RequestSet("laws", draw_asked(laws, rng, "laws")), catalogue, None)


def _columns(found: RequestSet, catalogue: ServiceCatalogue, horizon: int | None) -> Columns:
    """``found`` as requests of the only service of ``catalogue``."""
    kinds = [kind.name for kind in catalogue.resources]
    _warn_of_unused(found, kinds)
    if horizon is not None:
        for asked in found.requests:
            if asked.time >= horizon:
                raise ScenarioError(
                    f"{asked.name}: arrives at {asked.time:g} s, beyond the horizon of {horizon}; use a longer one, or "
                    "scenario.horizon=null for one that ends with the last arrival"
                )
    demands = [_demand(asked, kinds) for asked in found.requests]
    slot, time = slots_of(np.array([asked.time for asked in found.requests]))
    count = len(slot)
    return Columns(
        slot=slot,
        service=np.zeros(count, np.int64),
        ingress=np.full(count, FREE, np.int64),
        egress=np.full(count, FREE, np.int64),
        lifetime=np.array([asked.lifetime for asked in found.requests]),
        profile=1 + np.arange(count),
        own=to_profiles(demands, catalogue.resources),
        time=time,
    )


def _warn_of_unused(found: RequestSet, kinds: list[str]) -> None:
    """Name the numbers of the file that nothing is made of."""
    other = {name for asked in found.requests for name in asked.amounts if name not in kinds}
    unused = [*found.unused, *(f"{name} (a kind of resource that scenario.resources lacks)" for name in sorted(other))]
    if unused:
        warnings.warn(f"{found.source}: numbers that are not used: {', '.join(unused)}", ScenarioWarning, stacklevel=2)


def _demand(asked: Asked, kinds: list[str]) -> Demand:
    """What ``asked`` takes of the scenario's kinds."""
    for kind in kinds:
        if kind not in asked.amounts:
            raise ScenarioError(f"{asked.name}: says nothing of {kind!r}, one of scenario.resources; remove it there")
    functions = len(asked.processing_delay)
    if functions > MOST_FUNCTIONS:
        raise ScenarioError(f"{asked.name}: has {functions} functions; {MOST_FUNCTIONS} are the most that are read")
    numbers = [(kind, amount) for kind in kinds for amount in asked.amounts[kind]]
    for what, number in [*numbers, *(("a bandwidth", rate) for rate in asked.rates)]:
        if number != 0 and not 1 / LEDGER_UNITS <= number <= MAX_CAPACITY:
            raise ScenarioError(f"{asked.name}: {what} is {shown(number)}; use 0 or a number from 1e-6 to 1e9")
    if asked.tolerable_delay is not None and not asked.tolerable_delay > 0:
        raise ScenarioError(f"{asked.name}: tolerates a delay of {asked.tolerable_delay:g} ms; use a positive number")
    amounts = tuple(zip(*(asked.amounts[kind] for kind in kinds), strict=True))
    return Demand(0, amounts, asked.rates, asked.tolerable_delay, asked.processing_delay)
