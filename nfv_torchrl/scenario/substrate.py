"""The substrate network: nodes that hold VMs, links between them, capacities, delays and unit costs."""

from __future__ import annotations

import dataclasses
import difflib
import json
import os
import unicodedata
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import write_atomically
from nfv_torchrl.scenario.graph_files import read_node_link
from nfv_torchrl.scenario.limits import MAX_VMS
from nfv_torchrl.scenario.links import Links, merge_links
from nfv_torchrl.scenario.quoting import shown
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY, quantise

LONGEST_NAME = 500


@dataclass(frozen=True, eq=False)
class Substrate:
    """An undirected connected graph G(N, L) with VMs on its nodes (section "System Model" of the paper).

    Nodes are 0 .. N-1; people and workload files call them by id or label, see ``node_index``. Arrays are
    read-only; capacities are rounded to whole bit/s and cycles/s.

    Attributes:
        name: what tables and files call it.
        labels: N distinct node names, for people.
        vm_count: V_m, int64 [N]; a node without VMs only forwards.
        vm_capacity: psi in Mcycles/s, float64 [N, V], 0 where node n has no VM v (v >= vm_count[n]). V may exceed the
            largest ``vm_count``: a generator uses its upper bound, so that sizes do not change from seed to seed.
        vm_unit_cost: w in $ per Mcycles/s, float64 [N, V], 0 where there is no VM.
        links: ends u < v of each link, int64 [L, 2], sorted, no two alike. One capacity serves both directions, unless
            there is a ``back_capacity``.
        link_capacity: x in Mbit/s, float64 [L]; with ``back_capacity`` that from u to v.
        link_delay: propagation delay kappa in ms, float64 [L].
        link_unit_cost: w-hat in $ per Mbit/s, float64 [L].
        coordinates: latitude and longitude in degrees, float64 [N, 2], or None.
        ids: N distinct names, those by which the file that the network comes from refers to its nodes; if empty, as
            with generated networks, "0" .. "N-1".

    Raises:
        ScenarioError: shapes that do not fit, values out of range, or a graph that is not connected.
    """

    name: str
    labels: tuple[str, ...]
    vm_count: np.ndarray
    vm_capacity: np.ndarray
    vm_unit_cost: np.ndarray
    links: np.ndarray
    link_capacity: np.ndarray
    link_delay: np.ndarray
    link_unit_cost: np.ndarray
    coordinates: np.ndarray | None = None
    ids: tuple[str, ...] = ()
    resources: tuple[str, ...] = ("cpu",)
    extra_capacity: np.ndarray | None = None
    extra_unit_cost: np.ndarray | None = None
    back_capacity: np.ndarray | None = None

    def __post_init__(self) -> None:
        # Line breaks and rows of blanks, as drawings have them in labels, become single blanks.
        self._set("labels", tuple(" ".join(str(label).split()) for label in self.labels))
        self._set("ids", tuple(" ".join(str(name).split()) for name in self.ids) or self._numbers())
        for field in ("vm_count", "links"):
            self._set(field, np.array(getattr(self, field), np.int64))
        for field in ("vm_capacity", "link_capacity"):
            self._set(field, quantise(getattr(self, field)))
        for field in ("vm_unit_cost", "link_delay", "link_unit_cost"):
            self._set(field, np.array(getattr(self, field), np.float64))
        if self.coordinates is not None:
            self._set("coordinates", np.array(self.coordinates, np.float64))
        self._set("resources", tuple(self.resources))
        for field in ("extra_capacity", "back_capacity"):
            if getattr(self, field) is not None:
                self._set(field, quantise(getattr(self, field)))
        if self.extra_unit_cost is not None:
            self._set("extra_unit_cost", np.array(self.extra_unit_cost, np.float64))
        self.validate()
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def _set(self, field: str, value: Any) -> None:
        object.__setattr__(self, field, value)

    @property
    def num_nodes(self) -> int:
        """N."""
        return len(self.vm_count)

    @property
    def num_links(self) -> int:
        """|L|."""
        return len(self.links)

    @property
    def max_vms(self) -> int:
        """V_max, the VM slots of each node: an action index counts all of them, drawn or not."""
        return self.vm_capacity.shape[1]

    @property
    def total_vm_capacity(self) -> float:
        """Sum of psi over all VMs, Mcycles/s."""
        return float(self.vm_capacity.sum())

    @property
    def full_duplex(self) -> bool:
        """Whether each direction of a link has a capacity of its own."""
        return self.back_capacity is not None

    @property
    def capacity_by_kind(self) -> np.ndarray:
        """What each VM offers of each kind, float64 [N, V, R], 0 where there is no VM."""
        return _by_kind(self.vm_capacity, self.extra_capacity)

    @property
    def unit_cost_by_kind(self) -> np.ndarray:
        """Unit costs of each VM, $ per unit of each kind, float64 [N, V, R]."""
        return _by_kind(self.vm_unit_cost, self.extra_unit_cost)

    def scale_vm_capacity(self, factor: float) -> Substrate:
        """The same network with every VM's capacity, of every kind, times ``factor``."""
        extra = None if self.extra_capacity is None else self.extra_capacity * factor
        return dataclasses.replace(self, vm_capacity=self.vm_capacity * factor, extra_capacity=extra)

    # ---------------------------------------------------------------- names

    def node_index(self, name: str) -> int:
        """The node whose id or label is ``name``, 0 .. N-1; blanks around it do not count.

        A number is an id like any other: in a file whose ids start at 1, "1" is that file's first node.

        Raises:
            ScenarioError: no node is called so, or it is the id of one node and the label of another.
        """
        name = " ".join(name.split())
        by_id, by_label = self._by_id.get(name), self._by_label.get(name)
        if by_id is None and by_label is None:
            raise ScenarioError(f"unknown node {name!r}; {self._names_like(name)}")
        if by_id is not None and by_label is not None and by_id != by_label:
            raise ScenarioError(
                f"node {name!r}: is the id of node {self.labels[by_id]!r} and the label of the node with id "
                f"{self.ids[by_label]!r}; name that node by the other of its names"
            )
        return by_label if by_id is None else by_id  # type: ignore[return-value]  # one is an index

    def end_label(self, node: int) -> str:
        """The label of a request's ingress or egress, ``any`` where that is free (-1)."""
        return "any" if node < 0 else self.labels[node]

    def _numbers(self) -> tuple[str, ...]:
        """The ids of nodes that no file named."""
        return tuple(map(str, range(len(self.labels))))

    @cached_property
    def _by_id(self) -> dict[str, int]:
        return {name: node for node, name in enumerate(self.ids)}

    @cached_property
    def _by_label(self) -> dict[str, int]:
        return {name: node for node, name in enumerate(self.labels)}

    def _names_like(self, name: str) -> str:
        """What an error about an unknown ``name`` proposes."""
        if self.ids == self._numbers():
            known = f"the substrate's nodes are 0 .. {self.num_nodes - 1}"
        else:
            more = ", .." if self.num_nodes > 5 else ""
            known = f"use an id of the substrate's file ({', '.join(self.ids[:5])}{more})"
        close = difflib.get_close_matches(name, [*self.ids, *self.labels], n=1)
        return f"{known} or a label" + (f"; did you mean {close[0]!r}?" if close else "")

    # ---------------------------------------------------------------- checks

    def validate(self) -> None:
        """Refuse what is not a substrate; see the class for what that is."""
        self._check_shapes()
        self._check_vms()
        self._check_links()
        self._check_connected()
        if self.coordinates is not None and not np.isfinite(self.coordinates).all():
            raise self._error("coordinates must be finite numbers of degrees; use None if some are unknown")

    def _error(self, message: str) -> ScenarioError:
        return ScenarioError(f"substrate {self.name!r}: {message}")

    def _check_shapes(self) -> None:
        nodes, links = len(self.labels), len(self.links)
        if nodes < 2:
            raise self._error(f"has {nodes} node(s); a request needs an ingress and an egress, so at least 2")
        if len(set(self.labels)) != nodes:
            raise self._error("has two nodes with one label; labels must differ")
        for name in (*self.ids, *self.labels, self.name):
            if len(name) > LONGEST_NAME or any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
                raise ScenarioError(
                    f"substrate: the name {shown(name)} holds control characters or more than {LONGEST_NAME} "
                    "characters; shorten or correct it"
                )
        if len(self.ids) != nodes or len(set(self.ids)) != nodes:
            raise self._error(f"ids must be {nodes} different names, one for each node; leave them out for 0 .. N-1")
        vms = self.vm_capacity.shape[-1] if self.vm_capacity.ndim == 2 else 1
        expected: dict[str, tuple[int, ...]] = {
            "vm_count": (nodes,),
            "vm_capacity": (nodes, vms),
            "vm_unit_cost": (nodes, vms),
            "links": (links, 2),
            "link_capacity": (links,),
            "link_delay": (links,),
            "link_unit_cost": (links,),
        }
        if self.coordinates is not None:
            expected["coordinates"] = (nodes, 2)
        if self.back_capacity is not None:
            expected["back_capacity"] = (links,)
        kinds = len(self.resources)
        if not kinds or len(set(self.resources)) < kinds:
            raise self._error(f"resources are {shown(list(self.resources))}; give different names, at least one")
        for field in ("extra_capacity", "extra_unit_cost"):
            if (getattr(self, field) is not None) != (kinds > 1):
                raise self._error(f"{field} is for the {kinds - 1} kinds of resources beside the first; see resources")
            if kinds > 1:
                expected[field] = (nodes, vms, kinds - 1)
        for field, shape in expected.items():
            actual = getattr(self, field).shape
            if actual != shape:
                raise self._error(f"{field} has shape {list(actual)}; {list(shape)} was expected")

    def _check_vms(self) -> None:
        if self.vm_count.min() < 0 or self.vm_count.max() > self.max_vms:
            node = int(np.argmax((self.vm_count < 0) | (self.vm_count > self.max_vms)))
            raise self._error(f"node {node} has {self.vm_count[node]} VMs; 0 to {self.max_vms} are possible")
        if not self.vm_count.any():
            raise self._error("has no VM on any node; give at least one node a VM")
        exists = np.arange(self.max_vms) < self.vm_count[:, None]
        for field, unit in (("vm_capacity", "Mcycles/s"), ("vm_unit_cost", "$ per Mcycles/s")):
            self._check_vm_table(field, getattr(self, field), exists, unit)
        for kind, name in enumerate(self.resources[1:]):
            for field in ("extra_capacity", "extra_unit_cost"):
                self._check_vm_table(field, getattr(self, field)[:, :, kind], exists, f"of {name}")

    def _check_vm_table(self, field: str, values: np.ndarray, exists: np.ndarray, unit: str) -> None:
        if np.any(values[~exists] != 0):
            raise self._error(f"{field} must be 0 where a node has no VM")
        for node, vm in np.argwhere(exists & ~_usable(values)):
            raise self._error(_out_of_range(f"VM {vm} of node {node}", field, values[node, vm], unit))

    def _check_links(self) -> None:
        ends = self.links
        if ends.size and (ends.min() < 0 or ends.max() >= self.num_nodes):
            raise self._error(f"a link names a node outside 0 .. {self.num_nodes - 1}")
        if np.any(ends[:, 0] >= ends[:, 1]):
            raise self._error("each link must be (u, v) with u < v; links from a node to itself are not allowed")
        order = ends[:, 0] * self.num_nodes + ends[:, 1]
        if np.any(np.diff(order) <= 0):
            raise self._error("links must be sorted and distinct; merge_links does both")
        numbers = [("link_capacity", "Mbit/s"), ("link_unit_cost", "$ per Mbit/s")]
        for field, unit in [*numbers, ("back_capacity", "Mbit/s")] if self.full_duplex else numbers:
            values = getattr(self, field)
            for (link,) in np.argwhere(~_usable(values)):
                raise self._error(_out_of_range(f"link {ends[link].tolist()}", field, values[link], unit))
        for (link,) in np.argwhere(~((self.link_delay >= 0) & (self.link_delay <= MAX_CAPACITY))):
            raise self._error(
                f"link {ends[link].tolist()}: link_delay is {self.link_delay[link]} ms; use 0 to {MAX_CAPACITY:g}"
            )

    def _check_connected(self) -> None:
        graph = nx.empty_graph(self.num_nodes)
        graph.add_edges_from(self.links.tolist())
        parts = nx.number_connected_components(graph)
        if parts > 1:
            raise self._error(f"is not connected ({parts} parts); add links or keep its largest component only")

    # ---------------------------------------------------------------- files

    def to_networkx(self) -> nx.Graph:
        """A graph of nodes 0 .. N-1, with all that the substrate holds as attributes.

        Node: ``label``, ``file_id`` where that is not the node's number, ``vms`` (list of ``capacity``, ``unit_cost``),
        ``latitude`` and ``longitude`` if known. Link: ``capacity``, ``delay``, ``unit_cost``, with full duplex
        ``back_capacity``, from the greater node to the smaller. Graph: ``name``, ``max_vms`` (V, which the VMs alone do
        not tell), and ``resources`` where there is another kind than cpu: capacity and unit cost of a VM are then
        mappings from kinds to numbers.
        """
        graph = nx.Graph(name=self.name, max_vms=self.max_vms)
        if self.resources != ("cpu",):
            graph.graph["resources"] = list(self.resources)
        for node, label in enumerate(self.labels):
            graph.add_node(node, label=label, vms=self._vms_of_node(node))
            if self.ids[node] != str(node):
                graph.nodes[node]["file_id"] = self.ids[node]
            if self.coordinates is not None:
                latitude, longitude = self.coordinates[node].tolist()
                graph.nodes[node].update(latitude=latitude, longitude=longitude)
        for link, (u, v) in enumerate(self.links.tolist()):
            graph.add_edge(
                u,
                v,
                capacity=float(self.link_capacity[link]),
                delay=float(self.link_delay[link]),
                unit_cost=float(self.link_unit_cost[link]),
            )
            if self.back_capacity is not None:
                graph.edges[u, v]["back_capacity"] = float(self.back_capacity[link])
        return graph

    def _vms_of_node(self, node: int) -> list[dict[str, Any]]:
        """The VMs of a node, for JSON."""
        count = int(self.vm_count[node])
        capacity, unit_cost = self.capacity_by_kind[node, :count], self.unit_cost_by_kind[node, :count]
        if self.resources == ("cpu",):
            pairs = zip(capacity[:, 0].tolist(), unit_cost[:, 0].tolist(), strict=True)
            return [{"capacity": psi, "unit_cost": w} for psi, w in pairs]
        return [
            {
                "capacity": dict(zip(self.resources, psi, strict=True)),
                "unit_cost": dict(zip(self.resources, w, strict=True)),
            }
            for psi, w in zip(capacity.tolist(), unit_cost.tolist(), strict=True)
        ]

    @classmethod
    def from_networkx(cls, graph: nx.Graph, source: str = "graph") -> Substrate:
        """The inverse of ``to_networkx``; ``source`` names the graph in errors.

        Nodes that are 0 .. N-1 stay; others are numbered in the graph's order and kept as ids (and labels where there
        is none). Parallel links are merged, links from a node to itself dropped with a warning.

        Raises:
            ScenarioError: an attribute is missing or not a number, or the result is no substrate.
        """
        if graph.is_directed():
            raise ScenarioError(f"{source}: is directed; links serve both directions, so give an undirected graph")
        nodes = list(graph.nodes)
        if set(nodes) == set(range(len(nodes))):
            nodes.sort()
        index = {node: place for place, node in enumerate(nodes)}
        kinds = kinds_of(graph.graph, source)
        vms = [vms_of(graph.nodes[node], f"{source}: node {node!r}", kinds) for node in nodes]
        edges = [(u, v, _link_of(data, f"{source}: link {u!r} - {v!r}")) for u, v, data in graph.edges(data=True)]
        numbers = np.array([numbers for _, _, numbers in edges], np.float64).reshape(-1, 3)
        ends = np.array([(index[u], index[v]) for u, v, _ in edges], np.int64).reshape(-1, 2)
        links = merge_links(Links(ends, *numbers.T), source)
        count, capacity, unit_cost = _pad_vms(vms, graph.graph.get("max_vms"), source, len(kinds))
        back = back_capacities(
            [(index[u], index[v], data) for u, v, data in graph.edges(data=True)], links.ends, source
        )
        return cls(
            name=str(graph.graph.get("name") or source),
            labels=tuple(label_of(graph.nodes[node], node) for node in nodes),
            vm_count=count,
            vm_capacity=capacity[:, :, 0],
            vm_unit_cost=unit_cost[:, :, 0],
            resources=kinds,
            extra_capacity=capacity[:, :, 1:] if len(kinds) > 1 else None,
            extra_unit_cost=unit_cost[:, :, 1:] if len(kinds) > 1 else None,
            back_capacity=back,
            links=links.ends,
            link_capacity=links.capacity,
            link_delay=links.delay,
            link_unit_cost=links.unit_cost,
            coordinates=_coordinates_of([graph.nodes[node] for node in nodes], source),
            ids=tuple(str(graph.nodes[node].get("file_id", node)) for node in nodes),
        )

    def to_json(self, path: str | os.PathLike[str]) -> None:
        """Write the networkx ``node_link_data`` form of ``to_networkx``, with all digits."""
        graph = self.to_networkx()
        data = {
            "directed": False,
            "multigraph": False,
            "graph": graph.graph,
            "nodes": [{"id": node, **attributes} for node, attributes in graph.nodes(data=True)],
            "links": [{"source": u, "target": v, **attributes} for u, v, attributes in graph.edges(data=True)],
        }
        write_atomically(path, json.dumps(data, indent=1, allow_nan=False) + "\n")

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> Substrate:
        """Read what ``to_json`` wrote, or any ``node_link_data`` JSON with the same attributes, all of them.

        Links are taken from ``links`` or, as newer networkx writes them, ``edges``. A file that lacks some attributes
        is for ``read_topology``, which draws them.

        Raises:
            ScenarioError: the file cannot be read, is not of this form, or holds no substrate.
        """
        graph = read_node_link(Path(path)).to_networkx()
        if not graph.graph.get("name"):
            graph.graph["name"] = Path(path).stem
        return cls.from_networkx(graph, source=str(path))


def label_of(data: dict[str, Any], name: Any) -> str:
    """The label of a node with attributes ``data``, its id ``name`` where it has none."""
    label = data.get("label")
    return str(name if label in (None, "") else label)


def _usable(values: Any) -> Any:
    """Where ``values``, a number or an array, may be a capacity or a unit cost."""
    return np.isfinite(values) & (values > 0) & (values <= MAX_CAPACITY)


def _out_of_range(where: str, field: str, value: float, unit: str) -> str:
    return (
        f"{where}: {field} is {value} {unit}; it must be above 0 (capacities at least {1 / LEDGER_UNITS:g}) "
        f"and at most {MAX_CAPACITY:g}"
    )


def _number(data: Any, key: str, where: str) -> float:
    value = data.get(key) if isinstance(data, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise ScenarioError(f"{where}: {key!r} is {shown(value)}; a number was expected")
    try:
        return float(value)
    except OverflowError:
        raise ScenarioError(f"{where}: {key!r} is {shown(value)}; use a number of at most {MAX_CAPACITY:g}") from None


def vms_of(
    data: dict[str, Any], where: str, kinds: tuple[str, ...] = ("cpu",)
) -> list[tuple[list[float], list[float]]]:
    """Capacities and unit costs of each entry of a node's ``vms``, R numbers each; ``where`` names the node.

    With one kind a number will do; with several both are mappings from kinds to numbers.
    """
    vms = data.get("vms")
    if not isinstance(vms, list):
        raise ScenarioError(f"{where}: needs 'vms', a list of {{capacity, unit_cost}}; [] where it only forwards")
    return [
        (_amounts(vm, "capacity", f"{where}, VM {v}", kinds), _amounts(vm, "unit_cost", f"{where}, VM {v}", kinds))
        for v, vm in enumerate(vms)
    ]


def _amounts(vm: Any, key: str, where: str, kinds: tuple[str, ...]) -> list[float]:
    """Capacities or unit costs of a VM, one of each kind."""
    value = vm.get(key) if isinstance(vm, dict) else None
    if not isinstance(value, dict):
        if len(kinds) > 1:
            raise ScenarioError(f"{where}: {key!r} is {shown(value)}; give a number for each of {', '.join(kinds)}")
        return [_amount(vm, key, where)]
    if set(value) != set(kinds):
        raise ScenarioError(f"{where}: {key!r} has {', '.join(map(str, value))}; give {', '.join(kinds)}, no others")
    return [_amount(value, kind, f"{where}, {key}") for kind in kinds]


def _amount(vm: Any, key: str, where: str) -> float:
    """A capacity or unit cost of a VM."""
    value = _number(vm, key, where)
    if not _usable(value):
        unit = {"capacity": "Mcycles/s", "unit_cost": "$ per Mcycles/s"}.get(key, "")
        raise ScenarioError(_out_of_range(where, key, value, unit))
    return value


def kinds_of(graph: dict[str, Any], source: str) -> tuple[str, ...]:
    """The graph's ``resources``; the paper's where there are none."""
    kinds = graph.get("resources", ["cpu"])
    if not (isinstance(kinds, list) and kinds and all(isinstance(kind, str) for kind in kinds)):
        raise ScenarioError(f"{source}: 'resources' is {shown(kinds)}; give a list of names of kinds")
    return tuple(kinds)


def back_capacities(edges: list[tuple[int, int, dict[str, Any]]], ends: np.ndarray, source: str) -> np.ndarray | None:
    """Capacity from the greater to the smaller node of each link, float64 [L]; None if no link has one of its own."""
    there = [data for _, _, data in edges if "back_capacity" in data]
    if not there:
        return None
    if len(there) < len(edges) or len(edges) != len(ends):
        raise ScenarioError(
            f"{source}: some links have a 'back_capacity', others not, or links are parallel; correct it"
        )
    back = {(min(u, v), max(u, v)): _number(data, "back_capacity", f"{source}: link {u} - {v}") for u, v, data in edges}
    return np.array([back[u, v] for u, v in ends.tolist()])


def _link_of(data: dict[str, Any], where: str) -> tuple[float, float, float]:
    return _number(data, "capacity", where), _number(data, "delay", where), _number(data, "unit_cost", where)


def check_vm_slots(slots: int, source: str) -> None:
    """Refuse more VM slots a node than ``MAX_VMS``, before a table of them is made."""
    if slots > MAX_VMS:
        raise ScenarioError(
            f"{source}: {shown(slots)} VM slots a node ('max_vms' or a node's VMs); use at most {MAX_VMS}"
        )


def _pad_vms(
    vms: list[list[tuple[list[float], list[float]]]], max_vms: Any, source: str, kinds: int
) -> tuple[np.ndarray, ...]:
    """VM counts int64 [N], capacities and unit costs float64 [N, V, R] with V = ``max_vms`` or the largest count."""
    largest = max((len(node) for node in vms), default=1)
    width = max(largest, 1) if max_vms is None else max_vms
    if isinstance(width, bool) or not isinstance(width, int) or width < largest:
        raise ScenarioError(
            f"{source}: 'max_vms' is {shown(max_vms)}, but a node has {largest} VMs; raise or remove it"
        )
    check_vm_slots(width, source)
    table = np.zeros((2, len(vms), width, kinds))
    for node, pairs in enumerate(vms):
        if pairs:
            table[:, node, : len(pairs)] = np.array(pairs).transpose(1, 0, 2)
    return np.array([len(pairs) for pairs in vms], np.int64), table[0], table[1]


def _by_kind(first: np.ndarray, further: np.ndarray | None) -> np.ndarray:
    """Tables of the first kind [N, V] and of the further ones [N, V, R - 1] as one, [N, V, R]."""
    return first[:, :, None] if further is None else np.concatenate([first[:, :, None], further], axis=2)


def _coordinates_of(nodes: list[dict[str, Any]], source: str) -> np.ndarray | None:
    """Latitude and longitude float64 [N, 2], None unless every node has both."""
    if not all("latitude" in node and "longitude" in node for node in nodes):
        return None
    return np.array([[_number(node, key, source) for key in ("latitude", "longitude")] for node in nodes])
