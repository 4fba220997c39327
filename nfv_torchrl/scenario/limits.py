"""How large a scenario may be: what its arrays would take is estimated from its sizes before any is allocated.

The limit is half of the memory that is free on the machine (or in the container); the other half is left to networks,
replay memories and files. Sizes that the compact integers of the simulator cannot count are refused on any machine.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from nfv_torchrl.errors import ScenarioError

SHARE = 0.5
MAX_NODES = 2**15 - 1
MAX_VMS = 1000
"""VM slots of a node; more would need tables of more than 0.2 GB for 10,000 nodes."""
MAX_SLOTS = 2**31 - 2
MAX_REQUESTS = 10**9
MAX_STEPS = 10**8

PAIR_BYTES = 20
"""Of each ordered pair of nodes while a random graph is drawn."""
LINK_BYTES = 300
"""Of each link while a substrate is made, most of it the graph in which it is checked."""
REQUEST_BYTES = 200
"""Of each request of a workload, with what is in memory while it is drawn and written."""
SLOT_BYTES = 4
"""Of each slot of a horizon in an environment."""
STEP_BYTES = 20 + 12 * 8
"""Of each step that a walk may take: its log, and room for as many reservations."""
EVENT_BYTES = 300
"""Of each failure or repair, with its line in a decision folder."""
RESERVATIONS = 10
"""Of a running request, on average; chains have about five functions."""
POOL_GROWTH = 1.5
"""Pools of running requests grow by half when they run low."""

V2 = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current")
V1 = ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes")


class Sizes(NamedTuple):
    """What the memory of a scenario follows from.

    N ``nodes`` with V ``vms`` each and L ``links``, K ``services`` of at most F ``functions``, T slots of ``horizon``,
    R expected ``requests`` of which ``running`` at a time, J ``max_steps``, E expected failure ``events``; ``kinds`` of
    resources, and ``rates``: different least rates of profiles with a delay limit.
    """

    nodes: int
    vms: int
    links: int
    services: int
    functions: int
    horizon: int
    requests: float
    running: float
    max_steps: int
    events: float = 0.0
    kinds: int = 1
    rates: int = 1


def free_bytes() -> int:
    """Memory that new arrays may take on this machine, or in this container if it has less."""
    free = _machine_free()
    for most, now in (V2, V1):
        allowed, used = _read_number(most), _read_number(now)
        if allowed is not None and used is not None:
            free = min(free, max(allowed - used, 0))
    return free


def check_memory(*groups: Mapping[str, float]) -> None:
    """Refuse what would take more than the limit.

    Args:
        groups: bytes by the setting that they follow from, such as ``substrate.nodes=100``; all are added up.

    Raises:
        ScenarioError: too much; the message names the setting that takes most, the GB in all, and the limit.
    """
    total: dict[str, float] = {}
    for parts in groups:
        for name, size in parts.items():
            total[name] = total.get(name, 0.0) + size
    needed, limit = sum(total.values()), SHARE * free_bytes()
    if needed > limit:
        largest = max(total, key=lambda name: total[name])
        raise ScenarioError(
            f"{largest}: about {needed / 1e9:.3g} GB of memory would be needed; the limit is {limit / 1e9:.3g} GB, "
            "half of what is free here; use a smaller number"
        )


def would_take(needed: float) -> str:
    """For the refusal of a size that no machine takes: what its ``needed`` bytes come to."""
    return f" (this would take about {needed / 1e9:.3g} GB of memory)"


def times(parts: Mapping[str, float], count: int, what: str) -> dict[str, float]:
    """``parts`` for ``count`` of ``what`` they are of, such as environments."""
    return {f"{name} for {count} {what}": size * count for name, size in parts.items()}


def random_graph_parts(nodes: int, links: float, vms: int) -> dict[str, float]:
    """What drawing a random substrate takes, for ``check_memory``."""
    return {
        f"substrate.nodes={nodes}": PAIR_BYTES * float(nodes) ** 2,
        "substrate.mean_degree": LINK_BYTES * float(links),
        f"substrate.vms_max={vms}": 48.0 * nodes * vms,
    }


def table_parts(sizes: Sizes) -> dict[str, float]:
    """What the tables of one substrate take, whatever the number of environments."""
    pairs = float(sizes.nodes) ** 2
    return {
        f"substrate.nodes={sizes.nodes}": 16 * pairs
        + 24.0 * sizes.nodes * sizes.vms * sizes.kinds
        + 56.0 * sizes.links,
        f"services ({sizes.services})": 12 * pairs * sizes.rates
        + 8.0 * sizes.services * sizes.functions * (2 * sizes.kinds + 4),
    }


def workload_parts(sizes: Sizes) -> dict[str, float]:
    """What the requests and failures of one horizon take outside the simulator."""
    return {
        f"arrival_rate * horizon ({sizes.requests:.4g} requests)": REQUEST_BYTES * sizes.requests,
        f"failures ({sizes.events:.4g} events)": EVENT_BYTES * sizes.events,
    }


def environment_parts(sizes: Sizes, *, record: bool = False) -> dict[str, float]:
    """What one environment takes in the simulator (see ``simulator/state.py``); ``record``: with its decisions."""
    vms = float(sizes.nodes) * sizes.vms
    places = vms * sizes.kinds
    actions = 2 * vms + 1
    features = places + sizes.links + 5 + sizes.services + 2 * sizes.nodes + sizes.functions + 1
    records = max(256.0, POOL_GROWTH * sizes.running)
    entries = max(2048.0, POOL_GROWTH * RESERVATIONS * sizes.running)
    return {
        f"substrate.nodes={sizes.nodes}": 17 * (places + sizes.links) + 5 * actions + 4 * features,
        f"arrival_rate * horizon ({sizes.requests:.4g} requests)": (26 + 100 * record) * sizes.requests
        + 20 * records
        + 12 * entries,
        f"horizon={sizes.horizon}": SLOT_BYTES * float(sizes.horizon),
        f"max_steps={sizes.max_steps}": STEP_BYTES * float(sizes.max_steps),
        f"failures ({sizes.events:.4g} events)": 18 * sizes.events,
    }


def _machine_free() -> int:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):  # not Linux
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _read_number(path: str) -> int | None:
    try:
        return int(Path(path).read_text())
    except (OSError, ValueError):  # no such controller, or "max"
        return None
