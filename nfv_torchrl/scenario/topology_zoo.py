"""Placeholder until the reader lands."""

from __future__ import annotations

from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.substrate import Substrate


def read_topology(path: str, seed: int, **options: Any) -> Substrate:
    raise ScenarioError(f"{path}: reading topologies is not there yet")
