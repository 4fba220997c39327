"""What the walk rules cost: the cheapest walk against the paper's optimisation problem, request by request.

    python recipes/milp_gap.py [--seeds 10] [--requests 30]

Every seed draws one network of 4 to 8 nodes in the paper's ranges. A share of its VMs and links is full, the rest is
empty; requests of the paper's three services with random end nodes are embedded one by one by HiGHS, without
colocation, with it, and as eq. (main_prob) has it: functions on any VMs, any path between successive ones. Printed per
row: requests that only the problem can embed, and requests that both can embed but the problem more cheaply (% of those
it can embed at all), and what the walk costs more (% of the cost, where both embed); mean and 95 % interval over seeds.
"""

from __future__ import annotations

import argparse

import numpy as np

from nfv_torchrl.evaluation.statistics import Interval, mean_interval
from nfv_torchrl.planners.milp import Request, embed_slot
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.settings.recipes import MilpGapSettings, read_settings
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.cli import clear_errors

FULL_SHARES = ((0.0, 0.0), (0.4, 0.4), (0.9, 0.0), (0.9, 0.3))
"""Of VMs and of links; 0.9 of the VMs: a network with few places left to process anything."""
MAX_STEPS = 100


def compare(seed: int, full: tuple[float, float], colocation: bool, requests: int) -> tuple[float, float, float]:
    """Shares only the problem embeds and embeds more cheaply, and the mean extra cost of a walk, for one network."""
    scenario = paper_scenario(4 + seed % 5, seed)
    world = Simulator(scenario.replace(colocation=colocation, max_steps=MAX_STEPS), 1).world
    vms, links = world.ledger.vm_offered[0], world.ledger.link_offered[0]
    # The same draws in every row, so that rows differ by what is full and by nothing else.
    rng = np.random.default_rng(seed)
    vms *= rng.random(vms.shape) >= full[0]
    links *= rng.random(links.size) >= full[1]
    only, cheaper, extra, possible = 0, 0, [], 0
    for _ in range(requests):
        ingress, egress = rng.choice(scenario.substrate.num_nodes, 2, replace=False).tolist()
        request = Request(int(rng.integers(len(scenario.catalogue.types))), ingress, egress)
        (free,) = embed_slot(world, 0, [request], "problem")
        if free is None:
            continue
        possible += 1
        (walk,) = embed_slot(world, 0, [request], "walk")
        if walk is None:
            only += 1
            continue
        cheaper += free.cost < walk.cost - 1e-6
        extra.append(max(walk.cost / free.cost - 1.0, 0.0))  # two optima of one cost may differ in the last digit
    share = max(possible, 1)
    return only / share, cheaper / share, float(np.mean(extra)) if extra else np.nan


def shown(interval: Interval) -> str:
    return f"{100 * interval.mean:5.1f} ± {100 * interval.half_width:4.1f}"


@clear_errors
def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="The cheapest walk against the paper's optimisation problem.")
    parser.add_argument("--seeds", type=int, default=10, help="networks, seeds 0 .. SEEDS - 1")
    parser.add_argument("--requests", type=int, default=30, help="requests per network")
    options = parser.parse_args(arguments)
    read_settings(vars(options), MilpGapSettings)
    rows = [(full, colocation) for full in FULL_SHARES for colocation in (False, True)]
    results = [
        np.array([compare(seed, *row, options.requests) for seed in range(options.seeds)])
        for row in ProgressBar(rows, unit="row")
    ]
    print(f"seeds 0 .. {options.seeds - 1}, {options.requests} requests each, 4 to 8 nodes")
    print("| VMs, links full | colocation | only the problem, % | problem cheaper, % | walk costs more, % |")
    print("|---|---|---|---|---|")
    for (full, colocation), result in zip(rows, results, strict=True):
        cells = " | ".join(shown(mean_interval(column)) for column in result.T)
        print(f"| {full[0]:.0%}, {full[1]:.0%} | {'on' if colocation else 'off'} | {cells} |")


if __name__ == "__main__":
    main()
