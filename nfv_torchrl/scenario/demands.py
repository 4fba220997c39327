"""Demands: what one request of a file asks for, when that is not what its service asks for."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import unique_keys
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.profiles import MOST_FUNCTIONS, Profiles
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY
from nfv_torchrl.settings.values import shown

KEYS = ("amounts", "rates", "tolerable_delay", "processing_delay")


class Demand(NamedTuple):
    """One profile: ``amounts`` of each function and kind, ``rates`` of each segment (Mbit/s), ms or None for the rest.

    ``processing_delay``: of each function, or None where it follows from the amount of the first kind and the VM.
    """

    service: int
    amounts: tuple[tuple[float, ...], ...]  # [F][R]
    rates: tuple[float, ...]  # [F + 1]
    tolerable_delay: float | None
    processing_delay: tuple[float, ...] | None  # [F]


def parse_demand(text: str, service: int, kinds: Sequence[Resource], where: str) -> Demand:
    """The demand in a cell of a request file: a JSON object of ``KEYS``.

    ``amounts`` maps kinds to one number a function, ``rates`` is one number or F + 1 of them; the rest may be missing.

    Raises:
        ScenarioError: it is no such object; the message begins with ``where``.
    """
    try:
        data = json.loads(text, object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{where}: demand {shown(text)} is no JSON ({error}); correct it") from None
    if not isinstance(data, Mapping) or set(data) - set(KEYS) or not {"amounts", "rates"} <= set(data):
        raise ScenarioError(f"{where}: demand needs amounts and rates, and may have {KEYS[2]} and {KEYS[3]}, no others")
    amounts = _amounts(data["amounts"], kinds, f"{where}: demand.amounts")
    functions = len(amounts)
    rates = data["rates"]
    rates = _numbers(rates if isinstance(rates, list) else [rates] * (functions + 1), f"{where}: demand.rates")
    if len(rates) != functions + 1:
        raise ScenarioError(
            f"{where}: demand.rates has {len(rates)} numbers; {functions} functions have {functions + 1}"
        )
    tolerable, stated = data.get("tolerable_delay"), data.get("processing_delay")
    if tolerable is not None:
        (tolerable,) = _numbers([tolerable], f"{where}: demand.tolerable_delay", most=1e30)
        if tolerable <= 0:
            raise ScenarioError(f"{where}: demand.tolerable_delay is 0; use a positive number of ms, or leave it out")
    if stated is not None:
        stated = _numbers(stated, f"{where}: demand.processing_delay", most=1e30)
        if len(stated) != functions:
            raise ScenarioError(f"{where}: demand.processing_delay has {len(stated)} numbers; give {functions}")
    return Demand(service, amounts, rates, tolerable, stated)


def _amounts(data: Any, kinds: Sequence[Resource], where: str) -> tuple[tuple[float, ...], ...]:
    names = [kind.name for kind in kinds]
    if not isinstance(data, Mapping) or set(data) != set(names):
        raise ScenarioError(f"{where}: is {shown(data)}; give a list of numbers for each of {', '.join(names)}")
    columns = [_numbers(data[name], f"{where}.{name}") for name in names]
    if len({len(column) for column in columns}) != 1 or len(columns[0]) > MOST_FUNCTIONS:
        raise ScenarioError(f"{where}: give every kind as many numbers as there are functions, up to {MOST_FUNCTIONS}")
    return tuple(zip(*columns, strict=True))


def _numbers(values: Any, where: str, most: float = MAX_CAPACITY) -> tuple[float, ...]:
    """Numbers that are 0 or from a ledger unit to ``most``."""
    if not isinstance(values, list):
        raise ScenarioError(f"{where}: is {shown(values)}; a list of numbers was expected")
    for value in values:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not (value == 0 or 1 / LEDGER_UNITS <= value <= most):
            raise ScenarioError(f"{where}: {shown(value)}; use 0 or a number from 1e-6 to {most:g}")
    return tuple(float(value) for value in values)


def to_profiles(demands: Sequence[Demand], kinds: Sequence[Resource]) -> Profiles:
    """The demands as profiles, in order."""
    functions = max((len(demand.amounts) for demand in demands), default=0) or 1
    count = len(demands)
    amount = np.zeros((count, functions, len(kinds)))
    work, fixed_delay = np.zeros((count, functions)), np.zeros((count, functions))
    rate = np.zeros((count, functions + 1))
    for row, demand in enumerate(demands):
        length = len(demand.amounts)
        rate[row, : length + 1] = demand.rates
        if length:
            amount[row, :length] = demand.amounts
        if demand.processing_delay is not None:
            fixed_delay[row, :length] = demand.processing_delay
        elif kinds[0].scales_with_rate:
            work[row] = amount[row, :, 0]
    return Profiles(
        service=np.array([demand.service for demand in demands], np.int64),
        chain_length=np.array([len(demand.amounts) for demand in demands], np.int64),
        amount=amount,
        work=work,
        fixed_delay=fixed_delay,
        rate=rate,
        tolerable_delay=np.array(
            [np.inf if demand.tolerable_delay is None else demand.tolerable_delay for demand in demands], np.float64
        ),
    )


def write_demand(profiles: Profiles, row: int, kinds: Sequence[Resource]) -> str:
    """Profile ``row`` as JSON that ``parse_demand`` reads back to the bit."""
    length = int(profiles.chain_length[row])
    amounts = profiles.amount[row, :length]
    data: dict[str, Any] = {
        "amounts": {kind.name: amounts[:, place].tolist() for place, kind in enumerate(kinds)},
        "rates": profiles.rate[row, : length + 1].tolist(),
    }
    if np.isfinite(profiles.tolerable_delay[row]):
        data["tolerable_delay"] = float(profiles.tolerable_delay[row])
    if (kinds[0].scales_with_rate and not np.array_equal(profiles.work[row, :length], amounts[:, 0])) or np.any(
        profiles.fixed_delay[row] > 0
    ):
        data["processing_delay"] = profiles.fixed_delay[row, :length].tolist()
    return json.dumps(data, allow_nan=False)
