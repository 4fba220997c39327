"""Online service provisioning in NFV-enabled networks: learn it with TorchRL, compare it with heuristics and bounds.

What most scripts need can be imported from here; each name is loaded from its own module when it is first used, so that
``import nfv_torchrl`` by itself is quick and needs no torch::

    from nfv_torchrl import NFVEnv, paper_scenario

    env = NFVEnv(paper_scenario(nodes=10), batch_size=64)

``docs/design.md`` says what is in which subpackage, and what imports what.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nfv_torchrl.env import NFVEnv
    from nfv_torchrl.errors import AuditError, CheckpointError, ScenarioError
    from nfv_torchrl.evaluation.metrics import compute_metrics
    from nfv_torchrl.evaluation.runner import run_method
    from nfv_torchrl.losses import MaskedLoss, RequestLoss, greedy_actor
    from nfv_torchrl.methods import Method, PlannerMethod, PolicyMethod, RandomMethod, load_policy
    from nfv_torchrl.networks import QNetwork, Sizes
    from nfv_torchrl.scenario import Scenario, ServiceType, Substrate, Workload, paper_scenario, read_topology
    from nfv_torchrl.simulator import Simulator

__version__ = "0.1.0"

_HOMES = {
    "AuditError": "errors",
    "CheckpointError": "errors",
    "MaskedLoss": "losses",
    "Method": "methods",
    "NFVEnv": "env",
    "PlannerMethod": "methods",
    "PolicyMethod": "methods",
    "QNetwork": "networks",
    "RandomMethod": "methods",
    "RequestLoss": "losses",
    "Scenario": "scenario",
    "ScenarioError": "errors",
    "ServiceType": "scenario",
    "Simulator": "simulator",
    "Sizes": "networks",
    "Substrate": "scenario",
    "Workload": "scenario",
    "compute_metrics": "evaluation.metrics",
    "greedy_actor": "losses",
    "load_policy": "methods",
    "paper_scenario": "scenario",
    "read_topology": "scenario",
    "run_method": "evaluation.runner",
}

__all__ = [
    "AuditError",
    "CheckpointError",
    "MaskedLoss",
    "Method",
    "NFVEnv",
    "PlannerMethod",
    "PolicyMethod",
    "QNetwork",
    "RandomMethod",
    "RequestLoss",
    "Scenario",
    "ScenarioError",
    "ServiceType",
    "Simulator",
    "Sizes",
    "Substrate",
    "Workload",
    "compute_metrics",
    "greedy_actor",
    "load_policy",
    "paper_scenario",
    "read_topology",
    "run_method",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value  # the next look-up finds it here
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
