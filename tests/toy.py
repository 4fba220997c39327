"""A network of four nodes that fits on paper.

::

            l0: 10, 10 ms, $2          l2: 20, 5 ms, $1          capacity in Mbit/s, propagation in ms, $ per Mbit/s
        0 ------------------- 1
        |                   / |
        | l1: 5        l2 /   | l3: 4, 50 ms, $4
        | 20 ms, $1     /     |
        2 -------------       |
        |                     |
        +------- l4 --------- 3                               l4: 10, 30 ms, $2

    VM      capacity   $ per       duo A     duo B     solo A
            Mcycles/s  Mcycles/s   10 Mc/s   20 Mc/s   20 Mc/s
    0.0      40         3          250, 30   500, 60   500, 60     processing delay in ms, cost in $
    1.0      40         1          250, 10   500, 20   500, 20
    1.1     100         5          100, 50   200, 100  200, 100
    2.0      50         2          200, 20   400, 40   400, 40
    3.0      20         1          500, 10   1000, 20  1000, 20
    3.1      80         4          125, 40   250, 80   250, 80

    link    duo (1 Mbit/s)             solo (2 Mbit/s)
    l0      10 + 100 = 110 ms, $2      10 + 200 = 210 ms, $4
    l1      20 + 200 = 220 ms, $1      20 + 400 = 420 ms, $2
    l2       5 +  50 =  55 ms, $1       5 + 100 = 105 ms, $2
    l3      50 + 250 = 300 ms, $4      50 + 500 = 550 ms, $8
    l4      30 + 100 = 130 ms, $2      30 + 200 = 230 ms, $4

``duo`` is the chain A, B within 1050 ms; ``solo`` the chain A within 1000 ms.
"""

from __future__ import annotations

import numpy as np

from nfv_torchrl.scenario.failures import FailureModel, FailureTimeline
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload

NODES, VMS, LINKS = 4, 2, 5
REJECT = 16
DUO, SOLO = 0, 1

DUO_HOP_DELAY = [110.0, 220.0, 55.0, 300.0, 130.0]
SOLO_HOP_DELAY = [210.0, 420.0, 105.0, 550.0, 230.0]

# Least delays to a node, links only. Duo to 3: from 0 by 1 and 2 (110 + 55 + 130), from 1 by 2 (55 + 130).
DUO_DELAY_TO_3 = [295.0, 185.0, 130.0, 0.0]
# Solo to 0: from 3 by 2 and 1 (230 + 105 + 210), from 2 by 1 (105 + 210).
SOLO_DELAY_TO_0 = [0.0, 210.0, 315.0, 545.0]

# The dearest step there can be: solo's A on VM 1.1 ($100) after link l3 ($8).
LARGEST_STEP_COST = 108.0


def action(node: int, vm: int = 0, place: bool = False) -> int:
    """Go to ``node``, and place the next function on its VM ``vm`` or only forward."""
    return 2 * (node * VMS + vm) + place


# Cheapest embeddings on the empty network (see test_reference.py for why): cost, delay, actions.
DUO_0_TO_3 = (55.0, 945.0, [action(1, 0, True), action(2, 0, True), action(3)])
DUO_0_TO_3_COLOCATED = (35.0, 1045.0, [action(1, 0, True), action(1, 0, True), action(2), action(3)])
SOLO_3_TO_0 = (50.0, 945.0, [action(2, 0, True), action(1), action(0)])
# Cheapest once two duos sit on A at 1.0 and B at 2.0: no room for B on 2.0, so the walk bounces between 1 and 2.
DUO_0_TO_3_THIRD = (
    77.0,
    1005.0,
    [action(1, 1, True), action(2), action(1, 0, True), action(2), action(3)],
)


def toy_substrate() -> Substrate:
    return Substrate(
        name="toy",
        labels=("0", "1", "2", "3"),
        vm_count=np.array([1, 2, 1, 2]),
        vm_capacity=np.array([[40.0, 0.0], [40.0, 100.0], [50.0, 0.0], [20.0, 80.0]]),
        vm_unit_cost=np.array([[3.0, 0.0], [1.0, 5.0], [2.0, 0.0], [1.0, 4.0]]),
        links=np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]),
        link_capacity=np.array([10.0, 5.0, 20.0, 4.0, 10.0]),
        link_delay=np.array([10.0, 20.0, 5.0, 50.0, 30.0]),
        link_unit_cost=np.array([2.0, 1.0, 1.0, 4.0, 2.0]),
        coordinates=None,
    )


def toy_catalogue(duo_delay: float = 1050.0, solo_delay: float = 1000.0) -> ServiceCatalogue:
    return ServiceCatalogue(
        types=(
            ServiceType(name="duo", chain=("A", "B"), rate=1.0, tolerable_delay=duo_delay),
            ServiceType(name="solo", chain=("A",), rate=2.0, tolerable_delay=solo_delay),
        ),
        vnfs={"A": 10.0, "B": 20.0},
    )


def toy_scenario(**changes) -> Scenario:
    """Six slots; duo runs 0 to 3 or 1 to 3, solo 3 to 0 or 2 to 0."""
    settings = {
        "name": "toy",
        "seed": 0,
        "substrate": toy_substrate(),
        "catalogue": toy_catalogue(),
        "horizon": 6,
        "arrival_rate": 1.0,
        "mean_lifetime": 2.0,
        "endpoints": "catalogue",
        "endpoint_pairs": np.array([[[0, 3], [1, 3]], [[3, 0], [2, 0]]]),
        "failures": FailureModel(),
        "workload_path": None,
    }
    return Scenario(**(settings | changes))


def workload_of(*requests: tuple[int, int, int, int, float]) -> Workload:
    """From (slot, service, ingress, egress, lifetime) each."""
    slot, service, ingress, egress, lifetime = zip(*requests, strict=True)
    whole = {"slot": slot, "service": service, "ingress": ingress, "egress": egress}
    return Workload(
        **{name: np.array(values, dtype=np.int64) for name, values in whole.items()},
        lifetime=np.array(lifetime, dtype=np.float64),
    )


def toy_workload() -> Workload:
    """Two duos in slot 0 and a solo in slot 1 that all leave at slot 2, a duo in slot 1, and one from slot 3 on."""
    return workload_of(
        (0, DUO, 0, 3, 2.0),
        (0, DUO, 0, 3, 1.5),
        (1, SOLO, 3, 0, 0.2),
        (1, DUO, 0, 3, 3.0),
        (3, DUO, 0, 3, 10.0),
    )


def timeline_of(*events: tuple[int, int, bool]) -> FailureTimeline:
    """From (slot, resource, up) each, in the order applied."""
    slot, resource, up = zip(*events, strict=True)
    return FailureTimeline(slot=np.array(slot), resource=np.array(resource), up=np.array(up, dtype=bool))


def vm_resource(node: int, vm: int) -> int:
    return node * VMS + vm


def link_resource(link: int) -> int:
    return NODES * VMS + link
