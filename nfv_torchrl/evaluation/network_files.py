"""The commands ``nfv-torchrl show``, ``convert`` and ``scan``: what network files of any format hold.

``show FILE`` prints what was read, drawn and ignored, and draws the network. ``convert IN OUT`` writes it as JSON, and
its demands as CSV. ``scan`` says of many files which can be read, and names those that cannot.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import yaml
from matplotlib.figure import Figure

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.evaluation.network_figure import draw_network
from nfv_torchrl.scenario.demand_files import SERIES, read_demand_series, read_demands
from nfv_torchrl.scenario.formats.demands import MBIT_PER, DemandMatrix, write_demands
from nfv_torchrl.scenario.formats.topohub import PREFIX, topohub_keys
from nfv_torchrl.scenario.graph_files import SUFFIXES
from nfv_torchrl.scenario.quantities import QUANTITIES
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.topology_zoo import NetworkFile, read_network


def link_load(substrate: Substrate, demands: DemandMatrix) -> tuple[np.ndarray, int]:
    """Demand on each link, float64 [L] in the demands' unit, if all take paths of least delay; and how many have none.

    A demand has no path if the network lacks one of its nodes.
    """
    graph, load = substrate.to_networkx(), np.zeros(substrate.num_links)
    link_of = {frozenset(ends): link for link, ends in enumerate(substrate.links.tolist())}
    index = {name: node for node, name in enumerate(substrate.ids)}
    paths: dict[int, dict[int, list[int]]] = {}
    lost = 0
    for (u, v), value in zip(demands.pairs.tolist(), demands.values.tolist(), strict=True):
        start, end = index.get(demands.names[u]), index.get(demands.names[v])
        if start is None or end is None:
            lost += 1
            continue
        if start not in paths:
            paths[start] = nx.single_source_dijkstra_path(graph, start, weight="delay")
        path = paths[start][end]
        for hop in itertools.pairwise(path):
            load[link_of[frozenset(hop)]] += value
    return load, lost


def report(source: str, network: NetworkFile, said: Sequence[str]) -> str:
    """What was read, drawn and ignored, as text."""
    substrate, numbers = network
    lines = [f"{source}: {substrate.num_nodes} nodes, {substrate.num_links} links, {substrate.vm_count.sum()} VMs"]
    for key, quantity in QUANTITIES.items():
        values = numbers.values[key]
        given = int((~np.isnan(values)).sum())
        if key.startswith("vm_"):
            given = max(given, sum(node.get("vms") is not None for node in numbers.file.nodes))
        lines.append(f"  {key:<13} {quantity.unit:<17} {given:>6} of {len(values)} {quantity.owner}s in the file")
    for name, amounts, unit in (
        ("links", substrate.link_capacity, "Mbit/s"),
        ("delays", substrate.link_delay, "ms"),
        ("nodes' VMs", substrate.vm_capacity.sum(axis=1), "Mcycles/s"),
    ):
        lines.append(f"  {name:<13} {amounts.min():,.6g} to {amounts.max():,.6g} {unit}, {amounts.sum():,.6g} in all")
    demands = numbers.file.demands
    if demands is not None:
        unit = demands.unit or "of no unit"
        lines.append(f"  demands       {len(demands):,}, {demands.values.sum():,.6g} in all, {unit}")
    graph = sorted(name for name in numbers.file.attributes if name not in ("name", "demands"))
    lines += [f"  of the graph  not read: {', '.join(map(str, graph))}"] if graph else []
    return "\n".join([*lines, *(f"  note          {line}" for line in said)])


def link_shares(network: NetworkFile) -> tuple[np.ndarray, str]:
    """A share from 0 to 1 of each link, float64 [L], and what it is: of the demands' load if the file has demands."""
    capacity, demands = network.substrate.link_capacity, network.numbers.file.demands
    if demands is None:
        return capacity / capacity.max(), "capacity, share of the largest"
    load, _ = link_load(network.substrate, demands)
    if demands.unit in MBIT_PER:
        return np.minimum(load * MBIT_PER[demands.unit] / capacity, 1.0), "demands over capacity"
    return load / max(load.max(), 1e-300), "demands, share of the busiest link"


def draw_file(network: NetworkFile) -> Figure:
    """The network: nodes by the capacity of their VMs, links as wide as their capacity and coloured by their share."""
    substrate, (share, label) = network.substrate, link_shares(network)
    drawing = draw_network(substrate, np.zeros(substrate.num_nodes), share, label)
    drawing.links.set_linewidth((1 + 4 * substrate.link_capacity / substrate.link_capacity.max()).tolist())
    drawing.axes.set_title(substrate.name, fontsize=12)
    drawing.axes.set_xlabel("circles: nodes, by the capacity of their VMs; lines: links, by their capacity", fontsize=9)
    return drawing.figure


# -------------------------------------------------------------------- commands


def show(source: str, output: Path | None, **options: Any) -> None:
    """Print what a file holds, and draw it to ``output``.

    Raises:
        ScenarioError: the file cannot be read, or ``output`` is there.
    """
    if output is not None:
        _refuse_existing(output)
    network, said = _read(source, **options)
    print(report(source, network, said))
    if output is not None:
        draw_file(network).savefig(output, dpi=150, bbox_inches="tight")
        print(f"  drawn         {output}")


def convert(source: str, target: Path, **options: Any) -> None:
    """Write a network as JSON, and its demands as CSV beside it; to a ``.csv`` the demands only.

    Raises:
        ScenarioError: the file cannot be read, or a file to write is there.
    """
    if target.suffix.lower() == ".csv":
        _refuse_existing(target)
        write_demands(target, read_demand_series(source) if Path(source).is_dir() else [read_demands(source)])
        print(target)
        return
    if target.suffix.lower() != ".json":
        raise ScenarioError(f"{target}: networks are written as .json, demands as .csv; choose one of these endings")
    beside = target.with_suffix(".demands.csv")
    _refuse_existing(target)
    network, said = _read(source, **options)
    demands = network.numbers.file.demands
    if demands is not None:
        _refuse_existing(beside)
        write_demands(beside, [demands])
    network.substrate.to_json(target)
    print("\n".join([*said, str(target), *([str(beside)] if demands is not None else [])]))


def scan(sources: Iterable[str], limit: int | None, **options: Any) -> int:
    """Print how many of the files in folders, or in groups of TopoHub, are read, and name the others; their number."""
    refused = 0
    for source in sources:
        names = list(_files(source))[:limit]
        reasons: Counter[str] = Counter()
        for name in names:
            try:
                _read(name, **options)
                reasons["read"] += 1
            except ScenarioError as error:
                reasons["refused"] += 1
                print(f"refused: {error}")
        print(f"{source}: {len(names)} files, {reasons['read']} read, {reasons['refused']} refused")
        refused += reasons["refused"]
    return refused


def _files(source: str) -> Iterator[str]:
    """The network files of a folder, or of a group of TopoHub."""
    if source.startswith(PREFIX):
        yield from (f"{PREFIX}{key}" for key in topohub_keys(source.removeprefix(PREFIX)))
    elif Path(source).is_dir():
        yield from sorted(str(path) for path in Path(source).rglob("*") if path.suffix.lower() in SUFFIXES)
    else:
        yield source


def _read(source: str, **options: Any) -> tuple[NetworkFile, list[str]]:
    """A network, and what was warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ScenarioWarning)
        network = read_network(source, **options)
    return network, [str(warning.message).removeprefix(f"{source}: ") for warning in caught]


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise ScenarioError(f"{path}: exists already; choose another name or remove it first")


def _mapping(text: str) -> dict[str, Any]:
    value = yaml.safe_load(text)
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError("give a mapping such as '{capacity: {name: bw, unit: Gbit/s}}'")
    return value


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="nfv-torchrl", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    shown = commands.add_parser("show", help="what a file holds; what is read, drawn and ignored")
    shown.add_argument("source", help="a file, topohub: and a key, or a shipped topology")
    shown.add_argument("--output", type=Path, help="draw the network to this .png, .pdf or .svg")
    converted = commands.add_parser("convert", help="a network as JSON and its demands as CSV")
    converted.add_argument("source", help=f"a file, or a folder of demands ({', '.join(SERIES)})")
    converted.add_argument("target", type=Path, help="a .json, or a .csv for the demands only")
    scanned = commands.add_parser("scan", help="which of many files can be read")
    scanned.add_argument("sources", nargs="+", help="folders, files, or topohub: and a group")
    scanned.add_argument("--limit", type=int, help="at most so many files of each")
    for command in (shown, converted, scanned):
        command.add_argument("--seed", type=int, default=0, help="scenario seed, for what is drawn")
        command.add_argument("--directed", default="pairs", choices=["pairs", "merge"])
        command.add_argument("--largest-component", action="store_true")
        command.add_argument("--attributes", type=_mapping, help="as scenario.substrate.attributes")
    given = vars(parser.parse_args(arguments))
    refused, run = 0, given.pop("command")
    try:
        if run == "scan":
            refused = scan(**given)
        else:
            (show if run == "show" else convert)(**given)
    except (ScenarioError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if refused:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
