"""Requests in CSV files: the form, and a reader that refuses what could be meant in two ways."""

from __future__ import annotations

import csv
import difflib
import io
import math
import os
import re
from array import array
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_text, write_atomically
from nfv_torchrl.scenario.demands import Demand, parse_demand, to_profiles, write_demand
from nfv_torchrl.scenario.limits import MAX_SLOTS
from nfv_torchrl.scenario.profiles import Profiles
from nfv_torchrl.scenario.services import ANY, FREE, ServiceCatalogue
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.settings.values import shown

HEADER = ("slot", "service", "ingress", "egress", "lifetime")
"""Columns of a file that names nodes as the network's file does, by id or label."""
INDEX_HEADER = ("slot", "service", "ingress_index", "egress_index", "lifetime")
"""Columns of a file that numbers nodes 0 .. N-1 in the substrate's order, as the files that are written here."""
DEMAND = "demand"
"""A further column, where requests ask for something else than their service: JSON, see ``scenario/demands.py``."""
TIME = "time"
"""A further column, where requests arrive between the beginnings of slots: s, within the slot."""
KNOWN = (*HEADER, "ingress_index", "egress_index", DEMAND, TIME)
LONGEST_FIELD = 500

# int() and float() take more than a file should say: 1_000, infinity, digits of other scripts.
WHOLE = re.compile(r"[+-]?[0-9]{1,18}")
DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


class Columns(NamedTuple):
    """R requests: ``slot``, ``service``, ``ingress``, ``egress`` int64 [R], ``lifetime`` (s) float64 [R].

    ``profile`` int64 [R], ``own`` and ``time`` as in ``Workload``.
    """

    slot: np.ndarray
    service: np.ndarray
    ingress: np.ndarray
    egress: np.ndarray
    lifetime: np.ndarray
    profile: np.ndarray
    own: Profiles | None = None
    time: np.ndarray | None = None


def slots_of(time: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Slots int64 [R] of arrivals at ``time`` (s) float64 [R]; and ``time``, None if all come as their slot begins."""
    slot = np.floor(time).astype(np.int64)
    return slot, None if np.array_equal(slot, time) else time


def write_columns(path: str | os.PathLike[str], columns: Columns, catalogue: ServiceCatalogue) -> None:
    """Write a file with ``INDEX_HEADER``; services by name, lifetimes (s) with all their digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [catalogue.names[service] for service in columns.service]
    nodes = [[ANY if node == FREE else node for node in ends.tolist()] for ends in (columns.ingress, columns.egress)]
    rows = [columns.slot.tolist(), names, *nodes, columns.lifetime.tolist()]
    if columns.own is not None:
        first = len(catalogue.types)
        demands = [write_demand(columns.own, row, catalogue.resources) for row in range(len(columns.own))]
        rows.append([demands[place - first] if place >= first else "" for place in columns.profile.tolist()])
    header = INDEX_HEADER if columns.own is None else (*INDEX_HEADER, DEMAND)
    if columns.time is not None:
        header = (*header, TIME)
        rows.append(columns.time.tolist())
    writer.writerow(header)
    writer.writerows(zip(*rows, strict=True))
    write_atomically(path, text.getvalue())


def read_columns(
    path: str | os.PathLike[str],
    catalogue: ServiceCatalogue,
    substrate: Substrate,
    horizon: int | None,
    *,
    allow_empty: bool = False,
    numbers_are_indices: bool = False,
) -> Columns:
    """Read a file with ``HEADER`` or ``INDEX_HEADER``, its columns in any order.

    Args:
        path: the file.
        catalogue: whose services it names.
        substrate: whose nodes it names.
        horizon: slots are below it; None: there is no limit but ``limits.MAX_SLOTS``.
        allow_empty: whether a file without requests will do.
        numbers_are_indices: read ``ingress`` and ``egress`` as indices too: files written before there was
            ``INDEX_HEADER`` have these names.

    Raises:
        ScenarioError: a line does not fit the form, the services, the nodes or the horizon; the message names file,
            line and remedy.
    """
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True, skipinitialspace=True)
    try:
        header = _read_header(next(reader, []), f"{path}, line 1")
        row_parser = _RowParser(header, catalogue, substrate, horizon, numbers_are_indices)
        for row in reader:
            # A line of blanks is the end of many a file.
            if len(row) > 1 or any(field.strip() for field in row):
                row_parser.add(row, f"{path}, line {reader.line_num}")
    except csv.Error as error:
        raise ScenarioError(f"{path}, line {reader.line_num}: is not CSV ({error}); correct that line") from error
    if not row_parser.lifetime and not allow_empty:
        raise ScenarioError(f"{path}: holds no requests; add at least one line below the header")
    return row_parser.columns()


class _RowParser:
    """Collects the rows of one file."""

    def __init__(
        self,
        header: list[str],
        catalogue: ServiceCatalogue,
        substrate: Substrate,
        horizon: int | None,
        numbers_are_indices: bool,
    ) -> None:
        self.header = header
        self.services = {name: index for index, name in enumerate(catalogue.names)}
        self.catalogue = catalogue
        self.substrate = substrate
        self.horizon = MAX_SLOTS if horizon is None else horizon
        by_index = numbers_are_indices or "ingress_index" in header
        self.find: Callable[[str], int] = self._index if by_index else substrate.node_index
        self.nodes: dict[str, int] = {}  # what was looked up before
        # Compact: as tuples of Python numbers, ten million requests would take gigabytes.
        self.slot, self.service, self.ingress, self.egress = (array("q") for _ in range(4))
        self.lifetime, self.time = array("d"), array("d")
        self.profile = array("q")
        self.demands: dict[tuple[int, str], int] = {}  # profile by service and text: requests that are alike share it
        self.own: list[Demand] = []

    def columns(self) -> Columns:
        """All rows so far."""
        slot, service, ingress, egress, profile = (
            np.array(column, np.int64) for column in (self.slot, self.service, self.ingress, self.egress, self.profile)
        )
        own = to_profiles(self.own, self.catalogue.resources) if self.own else None
        time = slots_of(np.array(self.time, np.float64))[1] if self.time else None
        return Columns(slot, service, ingress, egress, np.array(self.lifetime, np.float64), profile, own, time)

    def add(self, row: list[str], where: str) -> None:
        """Take in one row; ``where`` names it in errors."""
        if len(row) != len(self.header):
            raise ScenarioError(
                f"{where}: has {len(row)} fields; {','.join(self.header)} are needed, separated by commas"
            )
        fields = {name.removesuffix("_index"): text.strip() for name, text in zip(self.header, row, strict=True)}
        slot = self._slot(fields["slot"], where)
        if fields["service"] not in self.services:
            known = shown([*self.services])
            raise ScenarioError(
                f"{where}: unknown service {shown(fields['service'])}; define it under services or use one of {known}"
            )
        ingress, egress = (self._node(fields[end], f"{where}: {end}") for end in ("ingress", "egress"))
        service = self.services[fields["service"]]
        profile, functions = self._profile(service, fields.get(DEMAND, ""), where)
        if functions == 0 and (ingress == egress or FREE in (ingress, egress)):
            raise ScenarioError(
                f"{where}: has no functions and no two different end nodes, so it asks for nothing; correct its "
                "ingress or egress"
            )
        if TIME in fields:
            self.time.append(self._time(fields[TIME], slot, where))
        self.profile.append(profile)
        self.lifetime.append(_lifetime(fields["lifetime"], where))
        self.slot.append(slot)
        self.service.append(service)
        self.ingress.append(ingress)
        self.egress.append(egress)

    def _profile(self, service: int, text: str, where: str) -> tuple[int, int]:
        """Number and functions of the profile of a row whose ``demand`` is ``text``."""
        if not text and self.catalogue.types[service].is_drawn:
            name = shown(self.catalogue.names[service])
            raise ScenarioError(
                f"{where}: requests of {name} draw what they ask for, so a file has to say it; give a demand, or "
                "services.NAME.rate and tolerable_delay one number each"
            )
        if not text:
            return service, len(self.catalogue.types[service].chain)
        if (service, text) not in self.demands:
            self.demands[service, text] = len(self.own)
            self.own.append(parse_demand(text, service, self.catalogue.resources, where))
        place = self.demands[service, text]
        return len(self.catalogue.types) + place, len(self.own[place].amounts)

    def _slot(self, text: str, where: str) -> int:
        if not WHOLE.fullmatch(text):
            raise ScenarioError(f"{where}: slot is {shown(text)}; use an integer, written with digits only")
        slot = int(text)
        if not 0 <= slot < self.horizon:
            raise ScenarioError(
                f"{where}: slot {slot} is outside 0 .. {self.horizon - 1}; correct it or change the horizon"
            )
        if self.slot and slot < self.slot[-1]:
            raise ScenarioError(f"{where}: slot {slot} follows {self.slot[-1]}; sort lines by slot")
        return slot

    def _time(self, text: str, slot: int, where: str) -> float:
        """The moment of an arrival, which is in ``slot`` and not before the one above it."""
        time = float(text) if DECIMAL.fullmatch(text) else math.nan
        if not slot <= time < slot + 1:
            raise ScenarioError(
                f"{where}: time {shown(text)} is not in slot {slot}; use s from {slot} to below {slot + 1}"
            )
        if self.time and time < self.time[-1]:
            raise ScenarioError(f"{where}: time {time:g} follows {self.time[-1]:g}; sort lines by time")
        return time

    def _node(self, text: str, where: str) -> int:
        if text == ANY:
            return FREE
        if text not in self.nodes:
            if len(text) > LONGEST_FIELD:
                raise ScenarioError(f"{where}: {shown(text)} is no node; use an id or label of the network's file")
            try:
                self.nodes[text] = self.find(text)
            except ScenarioError as error:
                raise ScenarioError(f"{where}: {error}") from error
        return self.nodes[text]

    def _index(self, text: str) -> int:
        count = self.substrate.num_nodes
        if not WHOLE.fullmatch(text) or not 0 <= int(text) < count:
            raise ScenarioError(f"unknown node index {shown(text)}; the substrate's nodes are 0 .. {count - 1}")
        return int(text)


def _read_header(row: list[str], where: str) -> list[str]:
    """The names of the columns, checked."""
    names = [name.strip() for name in row]
    problem = _header_problem(names)
    if problem:
        raise ScenarioError(f"{where}: the header must be {','.join(HEADER)}; {problem}")
    return names


def _header_problem(names: list[str]) -> str | None:
    if len(names) < 2:
        for separator, word in ((";", "';'"), ("\t", "tabs"), ("|", "'|'")):
            if separator in "".join(names):
                return f"the columns are separated by {word}: export the file with commas"
    for name in names:
        if names.count(name) > 1:
            return f"{shown(name)} is there twice: remove one"
        if name not in KNOWN:
            close = difflib.get_close_matches(name.lower(), KNOWN, n=1)
            return f"{shown(name)} is unknown: " + (f"did you mean {close[0]!r}?" if close else "remove that column")
    missing = _missing(HEADER, names)
    if missing and _missing(INDEX_HEADER, names):
        return f"{missing[0]!r} is missing: add it"
    if len(names) > len(HEADER) + (DEMAND in names) + (TIME in names):
        return "nodes are named by ingress and egress or by ingress_index and egress_index, not by both"
    return None


def _missing(wanted: Iterable[str], names: list[str]) -> list[str]:
    return [name for name in wanted if name not in names]


def _lifetime(text: str, where: str) -> float:
    value = float(text) if DECIMAL.fullmatch(text) else math.nan
    if not (math.isfinite(value) and value > 0):
        raise ScenarioError(f"{where}: lifetime {shown(text)}; use a positive number of seconds, such as 600 or 0.5")
    return value
