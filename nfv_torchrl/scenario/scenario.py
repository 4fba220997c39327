"""A scenario: substrate, services, arrivals and rules, everything that defines one experiment but the policy."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.arrivals import UNIFORM, ArrivalProcess, check_rate, parse_arrivals
from nfv_torchrl.scenario.config import HORIZON, ScenarioConfig, parse_config
from nfv_torchrl.scenario.failures import FailureModel, FailureTimeline, sample_timeline
from nfv_torchrl.scenario.limits import (
    MAX_REQUESTS,
    MAX_SLOTS,
    MAX_STEPS,
    REQUEST_BYTES,
    SLOT_BYTES,
    STEP_BYTES,
    Sizes,
    check_memory,
    environment_parts,
    table_parts,
    workload_parts,
    would_take,
)
from nfv_torchrl.scenario.profiles import Profiles, join_profiles
from nfv_torchrl.scenario.request_sets import mean_stay
from nfv_torchrl.scenario.resources import draw_further_kinds
from nfv_torchrl.scenario.services import LONGEST_MEAN, SHORTEST_MEAN, ServiceCatalogue
from nfv_torchrl.scenario.sources import build_substrate
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.traffic import Traffic, read_traffic
from nfv_torchrl.scenario.workload import Workload, count_pairs, decode_pairs
from nfv_torchrl.settings.values import parse, refuse, shown

ENDPOINTS = ("catalogue", "uniform")
MASKS = ("adjacency", "feasible")
STEP_BUDGETS = ("request", "slot")
PLACING_AFTER_CHAIN = ("masked", "forwards")
PLACEMENTS = ("walk", "colocate", "distinct")
KINDS: dict[str, Any] = {
    **dict.fromkeys(("name", "endpoints", "mask", "step_budget", "placing_after_chain"), str),
    **dict.fromkeys(("horizon", "warmup", "max_steps"), int),
    **dict.fromkeys(("colocation", "admission_control", "observe_lifetime"), bool),
    **dict.fromkeys(("workload_path", "placement"), str | None),
}
TARGET_RHO_TOLERANCE = 1e-6
READ_FOR = {
    "file_workload": {"workload_path", "catalogue", "substrate", "horizon", "seed"},
    "file_mean_lifetime": {"workload_path", "seed"},
    "traffic": {"arrivals", "substrate"},
}
"""What is read from files, and the attributes that it depends on."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """One experiment's world. Build it with ``from_config`` or ``paper_scenario``.

    Attributes:
        name: what tables and files call it.
        seed: draws topology, resources and endpoint pairs. Workload seeds are apart, see ``workload``.
        substrate: the network.
        catalogue: service types and VNFs.
        horizon: T, slots (s) of one run.
        warmup: first slots that metrics leave out.
        arrival_rate: lambda, mean number of arrivals per slot; of ``uniform`` arrivals its double is an integer.
        arrivals: the law of the arrivals, see ``nfv_torchrl.scenario.arrivals``.
        mean_lifetime: mu, s, of the services that have none of their own.
        endpoints: ``catalogue``: a request takes one of its type's pairs; ``uniform``: it draws any two nodes.
        endpoint_pairs: (ingress, egress) of P pairs for each of K types, int64 [K, P, 2]; None when ``uniform``.
        colocation: a function may also go to a VM of the current node.
        placement: ``distinct``: no two functions of a request may stand on one node; else None. ``walk`` and
            ``colocate`` can be given instead of ``colocation`` and are kept there.
        mask: ``adjacency`` (the paper's) or ``feasible`` (also leaves out what a check would refuse).
        admission_control: the policy may always reject.
        observe_lifetime: policies and planners see a request's lifetime.
        max_steps: J, steps a request's walk may take.
        step_budget: ``request``: every request has J steps; ``slot``: the requests of one service in a slot share J (a
            service is what the observation tells as one: a type with a pair of endpoints, or a type where these are
            ``uniform``). A rejected request has used the steps that it passed.
        placing_after_chain: what an action that places is once all functions are placed: ``masked``: not among the
            possible actions; ``forwards``: as possible as one that forwards, and counted as such (Algorithm 3).
        failures: probabilities of failures and repairs.
        workload_path: file or folder of requests that replaces the sampled workloads, or None.

    Raises:
        ScenarioError: a value is out of range or does not fit the others.
    """

    name: str
    seed: int
    substrate: Substrate
    catalogue: ServiceCatalogue
    horizon: int = HORIZON
    warmup: int = ScenarioConfig.warmup
    arrival_rate: float = ScenarioConfig.arrival_rate
    mean_lifetime: float = ScenarioConfig.mean_lifetime
    endpoints: str = ScenarioConfig.endpoints
    endpoint_pairs: np.ndarray | None = None
    colocation: bool = ScenarioConfig.colocation
    mask: str = ScenarioConfig.mask
    admission_control: bool = ScenarioConfig.admission_control
    observe_lifetime: bool = ScenarioConfig.observe_lifetime
    max_steps: int = ScenarioConfig.max_steps
    failures: FailureModel = field(default_factory=FailureModel)
    workload_path: str | None = None
    placement: str | None = None
    arrivals: ArrivalProcess = UNIFORM
    step_budget: str = ScenarioConfig.step_budget
    placing_after_chain: str = ScenarioConfig.placing_after_chain

    def __post_init__(self) -> None:
        self._check_kinds()
        self._check_placement()
        self._check_numbers()
        for key, known in (
            ("endpoints", ENDPOINTS),
            ("mask", MASKS),
            ("step_budget", STEP_BUDGETS),
            ("placing_after_chain", PLACING_AFTER_CHAIN),
        ):
            if getattr(self, key) not in known:
                raise ScenarioError(f"{key}: {shown(getattr(self, key))} is unknown; use one of {list(known)}")
        self._check_pairs()
        self._check_profiles()
        self._check_size()

    def _check_kinds(self) -> None:
        """Values come from Python too, where no parser has seen them; numbers become Python's own, for JSON."""
        object.__setattr__(self, "arrivals", parse_arrivals(self.arrivals, "arrivals"))
        for key, part in (("substrate", Substrate), ("catalogue", ServiceCatalogue), ("failures", FailureModel)):
            if not isinstance(getattr(self, key), part):
                refuse(key, getattr(self, key), f"a {part.__name__}")
        for key, hint in KINDS.items():
            object.__setattr__(self, key, parse(getattr(self, key), hint, key))
        for key in ("arrival_rate", "mean_lifetime"):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
                refuse(key, value, "a number")

    def _check_numbers(self) -> None:
        generator(self.seed, Stream.TOPOLOGY)  # refuses what is no seed
        for key, most, each in (("horizon", MAX_SLOTS, SLOT_BYTES), ("max_steps", MAX_STEPS, STEP_BYTES)):
            value = getattr(self, key)
            if not 1 <= value <= most:
                size = would_take(each * float(value)) if value > most else ""
                raise ScenarioError(f"{key}: {shown(value)}; use an integer from 1 to {most}{size}")
        if not 0 <= self.warmup < self.horizon:
            raise ScenarioError(
                f"warmup: {shown(self.warmup)} slots; use 0 or more, below the horizon of {self.horizon}"
            )
        check_rate(self.arrivals, self.arrival_rate, MAX_REQUESTS)
        self._check_arrivals()
        if not SHORTEST_MEAN <= self.mean_lifetime <= LONGEST_MEAN:
            raise ScenarioError(
                f"mean_lifetime: {shown(self.mean_lifetime)} s; use a positive number, "
                f"from {SHORTEST_MEAN:g} to {LONGEST_MEAN:g}"
            )

    def _check_arrivals(self) -> None:
        """A process goes with where requests come from and where they end."""
        process = self.arrivals.process
        if process == "file" and self.workload_path is None:
            raise ScenarioError("arrivals: file, but workload.path is null; give a file, or another process")
        if process not in ("uniform", "file") and self.workload_path is not None:
            raise ScenarioError(f"arrivals: {process}, but requests come from workload.path; keep one of the two")
        if process == "matrix" and self.endpoints != "uniform":
            raise ScenarioError("arrivals: matrix draws the ends of requests; set endpoints=uniform")

    def _check_placement(self) -> None:
        """``walk`` and ``colocate`` say what ``colocation`` says."""
        if self.placement is None:
            return
        if self.placement not in PLACEMENTS:
            raise ScenarioError(f"placement: {shown(self.placement)} is unknown; use one of {list(PLACEMENTS)}")
        if self.colocation and self.placement != "colocate":
            raise ScenarioError(f"placement: {self.placement} and colocation: true exclude each other; keep one")
        object.__setattr__(self, "colocation", self.placement == "colocate")
        object.__setattr__(self, "placement", "distinct" if self.placement == "distinct" else None)

    def _check_profiles(self) -> None:
        """The kinds of resources go together, and with failures everything that a request uses takes something."""
        names = tuple(kind.name for kind in self.catalogue.resources)
        if names != self.substrate.resources:
            raise ScenarioError(
                f"resources: the services ask for {', '.join(names)}, VMs of {self.substrate.name!r} offer "
                f"{', '.join(self.substrate.resources)}; name the same kinds in the same order"
            )
        if not self.failures.off and self.catalogue.profiles.asks_for_nothing():
            raise ScenarioError(
                "failures: a function or segment takes nothing, so what has failed could serve it; give it an amount "
                "or switch failures off"
            )

    def _check_size(self) -> None:
        """Refuse what cannot be held: one environment, one workload, the tables."""
        requests = self.arrival_rate * self.horizon
        if self.workload_path is None and requests > MAX_REQUESTS:
            raise ScenarioError(
                f"arrival_rate * horizon: {requests:.4g} requests; use at most {MAX_REQUESTS}; lower one of the two"
                + would_take(REQUEST_BYTES * requests)
            )
        sizes = self.sizes
        check_memory(table_parts(sizes), workload_parts(sizes), environment_parts(sizes))

    @property
    def sizes(self) -> Sizes:
        """What the memory of an experiment follows from; requests: as expected, or of a file that was read."""
        from_file = vars(self).get("file_workload")
        requests = self.arrival_rate * self.horizon if from_file is None else len(from_file)
        # Twice the average requests that the VMs can carry: who rejects the large ones carries more of the small.
        load = self.catalogue.mean_load
        room = 2 * self.substrate.total_vm_capacity / load if load > 0 and from_file is None else math.inf
        return Sizes(
            nodes=self.substrate.num_nodes,
            vms=self.substrate.max_vms,
            links=self.substrate.num_links * (2 if self.substrate.full_duplex else 1),
            services=len(self.catalogue.types) + len(self.catalogue.drawn or ())
            if from_file is None
            else len(self.profiles),
            functions=int(self.profiles.amount.shape[1]) if from_file is not None else self._longest_chain,
            horizon=self.horizon,
            requests=requests,
            running=min(requests, requests * self.longest_mean / self.horizon, room),
            max_steps=self.max_steps,
            events=self.failures.expected_events(self.substrate, self.horizon),
            kinds=len(self.substrate.resources),
            rates=self._different_rates if from_file is None or from_file.own is None else from_file.own.least_rates,
        )

    @property
    def _longest_chain(self) -> int:
        return max(int(self.catalogue.chain_length.max()), 1)

    @property
    def _different_rates(self) -> int:
        types = self.catalogue.types
        return len({rate for each in types for rate in (*each.segment_rates, *each.drawn_values[0].tolist())})

    @property
    def mean_lifetimes(self) -> np.ndarray:
        """Mean lifetime of each service, s, float64 [K]."""
        own = [service.mean_lifetime for service in self.catalogue.types]
        return np.array([self.mean_lifetime if mean is None else mean for mean in own], np.float64)

    @property
    def longest_mean(self) -> float:
        """The longest of the services' mean lifetimes, s."""
        return float(self.mean_lifetimes.max())

    @property
    def usual_lifetime(self) -> float:
        """Mean lifetime over the mix of services, s."""
        if all(service.mean_lifetime is None for service in self.catalogue.types):
            return float(self.mean_lifetime)
        return float(self.catalogue.mix @ self.mean_lifetimes)

    @property
    def placement_rule(self) -> str:
        """``walk``, ``colocate`` or ``distinct``."""
        return self.placement or ("colocate" if self.colocation else "walk")

    @property
    def free_ends(self) -> bool:
        """Whether requests may leave it open where their first or last function stands."""
        if self.workload_path is not None:
            return self.file_workload.free_ends
        return any(service.free_ends for service in self.catalogue.types)

    @property
    def open_pairs(self) -> bool:
        """Whether requests come on other ends than the pairs of the catalogue: their service does not tell these."""
        if self.endpoint_pairs is None or self.free_ends:
            return True
        return self.workload_path is not None and not self._all_on_pairs(self.file_workload)

    def _all_on_pairs(self, workload: Workload) -> bool:
        """Whether every request is on one of the pairs of its service."""
        assert self.endpoint_pairs is not None
        ends = np.stack([workload.ingress, workload.egress], axis=1)
        return bool((self.endpoint_pairs[workload.service] == ends[:, None]).all(axis=2).any(axis=1).all())

    @cached_property
    def profiles(self) -> Profiles:
        """What requests may ask for: the services of the catalogue; then what they draw, or what a file brings."""
        own = self.catalogue.drawn if self.workload_path is None else self.file_workload.own
        if own is None:
            return self.catalogue.profiles
        if not self.failures.off and own.asks_for_nothing():
            raise ScenarioError(
                f"{self.workload_path or 'services'}: a function or segment takes nothing, so what has failed could "
                "serve it; give it an amount or switch failures off"
            )
        return join_profiles([self.catalogue.profiles, own])

    def _check_pairs(self) -> None:
        if (self.endpoints == "catalogue") != (self.endpoint_pairs is not None):
            raise ScenarioError("endpoint_pairs: needed with endpoints=catalogue, must be None with endpoints=uniform")
        if self.endpoint_pairs is None:
            return
        pairs, types = np.asarray(self.endpoint_pairs), len(self.catalogue.types)
        if pairs.dtype.kind not in "iu":
            raise ScenarioError(f"endpoint_pairs: are {pairs.dtype}; nodes are integers")
        object.__setattr__(self, "endpoint_pairs", pairs.astype(np.int64, copy=False))
        if pairs.ndim != 3 or pairs.shape[0] != types or pairs.shape[1] < 1 or pairs.shape[2] != 2:
            raise ScenarioError(f"endpoint_pairs: shape {list(pairs.shape)}; [{types}, P, 2] was expected")
        if pairs.min() < 0 or pairs.max() >= self.substrate.num_nodes:
            raise ScenarioError(f"endpoint_pairs: nodes must lie in 0 .. {self.substrate.num_nodes - 1}")
        if np.any(pairs[..., 0] == pairs[..., 1]):
            raise ScenarioError("endpoint_pairs: a pair has one node as ingress and egress; they must differ")

    @classmethod
    def from_config(cls, config: Mapping[str, Any] | ScenarioConfig) -> Scenario:
        """Build a scenario from a plain mapping (as of the yaml files in ``recipes/config/scenario``).

        Raises:
            ScenarioError: an unknown key or a wrong value, named with the remedy; or a file that cannot be used.
        """
        config = parse_config(config)
        catalogue = ServiceCatalogue(tuple(config.services.values()), config.vnfs, config.resources)
        substrate = draw_further_kinds(build_substrate(config.substrate, config.seed), config.resources, config.seed)
        pairs = None
        if config.endpoints == "catalogue":
            pairs = draw_endpoint_pairs(len(catalogue.types), config.pairs_per_service, substrate, config.seed)
        shared = {spec.name for spec in dataclasses.fields(cls)} & {spec.name for spec in dataclasses.fields(config)}
        taken = {key: getattr(config, key) for key in shared - {"substrate"}}
        path, requests = config.workload.path, None
        if path is not None:  # a bad file is refused now, not hours later
            requests = Workload.from_file(path, catalogue, substrate, config.horizon, config.seed)
        taken["horizon"] = _horizon(config, requests)
        scenario = cls(substrate=substrate, catalogue=catalogue, endpoint_pairs=pairs, workload_path=path, **taken)
        if requests is not None:
            vars(scenario)["file_workload"] = requests
            _ = scenario.profiles
        if config.arrivals.process == "matrix":
            _ = scenario.traffic
        return scenario._scaled_to(config.substrate.target_rho)

    def _scaled_to(self, target_rho: float | None) -> Scenario:
        """The scenario with all VM capacities scaled by one factor so that the offered load is ``target_rho``."""
        if target_rho is None:
            return self
        factor = self.offered_load() / target_rho
        # A substrate that was scaled before and written to a file comes back as it is, to the bit.
        if abs(factor - 1) <= TARGET_RHO_TOLERANCE:
            return self
        return self.replace(substrate=self.substrate.scale_vm_capacity(factor))

    def replace(self, **changes: Any) -> Scenario:
        """A copy with some attributes changed (and checked again)."""
        other = dataclasses.replace(self, **changes)
        for name, needs in READ_FOR.items():  # a folder of a thousand files is read once
            if name in vars(self) and not changes.keys() & needs:
                vars(other)[name] = vars(self)[name]
        return other

    def offered_load(self) -> float:
        """rho, the processing load offered over that installed.

        rho = lambda mu (1 - exp(-T / mu)) (mean over the mix of sum of d B) / (sum of psi): requests running at the end
        of a horizon that began empty, were all accepted, over the sum of VM capacities. With a workload file lambda, mu
        and the mean load are those of its requests. Of several kinds of resources, the scarcest counts.
        """
        rate, lifetime = self.arrival_rate, self.mean_lifetime
        loads = self.catalogue.mix @ self.catalogue.load.sum(axis=1), *self._mean_extra_loads()
        if self.workload_path is not None:
            requests = self.file_workload
            rate, lifetime = len(requests) / self.horizon, float(requests.lifetime.mean())
            loads = tuple(
                self.profiles.amount[:, :, kind].sum(axis=1)[requests.profile].mean() for kind in range(len(loads))
            )
        elif self.longest_mean != self.mean_lifetime or self.mean_lifetimes.min() != self.mean_lifetime:
            return self._load_of_lifetimes()
        running = rate * lifetime * -math.expm1(-self.horizon / lifetime)
        return self._over_installed([running * float(load) for load in loads])

    def _load_of_lifetimes(self) -> float:
        """The offered load where services have mean lifetimes of their own: the sum of what each of them brings."""
        means = self.mean_lifetimes
        running = self.arrival_rate * self.catalogue.mix * means * -np.expm1(-self.horizon / means)
        return self._over_installed((running @ self.catalogue.profiles.total).tolist())

    def _over_installed(self, loads: Sequence[float]) -> float:
        """The highest share that a load of some kind, Mcycles/s or units, is of what all VMs offer."""
        extra = self.substrate.extra_capacity
        installed = self.substrate.total_vm_capacity, *([] if extra is None else extra.sum(axis=(0, 1)).tolist())
        return max(load / there for load, there in zip(loads, installed, strict=True))

    def _mean_extra_loads(self) -> list[float]:
        """Load of a whole chain on each further kind, averaged over the mix."""
        return (self.catalogue.mix @ self.catalogue.profiles.total[:, 1:]).tolist()

    @cached_property
    def file_workload(self) -> Workload:
        """The requests of ``workload_path``, read once."""
        if self.workload_path is None:
            raise ScenarioError(
                "workload.path: is null, so there is no file to read; give a file or folder of requests"
            )
        return Workload.from_file(self.workload_path, self.catalogue, self.substrate, self.horizon, self.seed)

    @cached_property
    def file_mean_lifetime(self) -> float | None:
        """Mean of the exponential law that lifetimes of ``workload_path`` are drawn from, s; None: it names none."""
        return None if self.workload_path is None else mean_stay(self.workload_path, self.seed)

    @cached_property
    def traffic(self) -> Traffic:
        """The traffic matrices of ``arrivals``, read once."""
        if self.arrivals.path is None:
            raise ScenarioError("arrivals.path: is null, so there are no traffic matrices to read; use arrivals=matrix")
        return read_traffic(self.arrivals.path, self.substrate, self.arrivals.interval)

    def workload(self, seed: int, *key: int) -> Workload:
        """The requests of workload seed ``seed``, always the same; with a workload file those, whatever the seed.

        ``key`` splits the seed further, such as by an env's index and an episode's number.
        """
        if self.workload_path is not None:
            return self.file_workload
        return Workload.sample(self, generator(seed, Stream.WORKLOAD, *key))

    def failure_timeline(self, seed: int, *key: int) -> FailureTimeline:
        """Failures and repairs of workload seed ``seed``; empty when failures are off."""
        return sample_timeline(self.failures, self.substrate, self.horizon, generator(seed, Stream.FAILURES, *key))


def _horizon(config: ScenarioConfig, requests: Workload | None) -> int:
    """T: as stated, or up to the last request of a file."""
    if config.horizon is not None:
        return config.horizon
    if requests is None:
        raise ScenarioError(
            "horizon: is null, which means up to the last request of workload.path; give a number of slots"
        )
    return int(requests.slot[-1]) + 1


def draw_endpoint_pairs(types: int, pairs_per_service: int, substrate: Substrate, seed: int) -> np.ndarray:
    """P distinct (ingress, egress) pairs for each service type, int64 [K, P, 2].

    A type with a pair is one of the paper's K services. Each type has a generator of its own, and a larger P keeps the
    pairs of a smaller one.

    Raises:
        ScenarioError: the network has fewer than P such pairs.
    """
    possible = count_pairs(substrate.num_nodes)
    parse(pairs_per_service, int, "pairs_per_service")
    if not 1 <= pairs_per_service <= possible:
        raise ScenarioError(
            f"pairs_per_service: {pairs_per_service}; a network of {substrate.num_nodes} nodes has {possible} distinct "
            f"(ingress, egress) pairs, so use 1 .. {possible}, or endpoints=uniform"
        )
    check_memory(
        {
            f"pairs_per_service={pairs_per_service}": 32.0 * types * pairs_per_service,
            f"substrate.nodes={substrate.num_nodes}": 8.0 * possible,
        }
    )
    codes = [
        _first_of_permutation(generator(seed, Stream.CATALOGUE, kind), possible, pairs_per_service)
        for kind in range(types)
    ]
    return np.stack(decode_pairs(np.array(codes, np.int64), substrate), axis=-1)


def _first_of_permutation(rng: np.random.Generator, possible: int, count: int) -> np.ndarray:
    """The first numbers of a permutation, int64 [count]: a copy, so that the rest is given back."""
    return rng.permutation(possible)[:count].copy()


def paper_scenario(nodes: int = 10, seed: int = 0, **changes: Any) -> Scenario:
    """The paper's simulation setting with N = ``nodes``; ``changes`` are further keys of ``ScenarioConfig``.

    For instance ``paper_scenario(colocation=True, substrate={"vms_max": 2}, failures={"p_repair": 0.1})``.
    """
    substrate = {"nodes": nodes, **changes.pop("substrate", {})}
    return Scenario.from_config({"seed": seed, "substrate": substrate, **changes})
