"""The small worlds in which the checkers try things out."""

from __future__ import annotations

from typing import Any

from nfv_torchrl.scenario import Scenario


def small_scenario(**settings: Any) -> Scenario:
    """Six nodes, a few requests a slot, and so little capacity that some requests have to be refused.

    ``settings`` replace keys of the scenario. A policy may always reject, and sees only steps that can be carried out.
    """
    substrate = {"nodes": 6, "vm_capacity": [200.0, 400.0], **settings.pop("substrate", {})}
    chosen = {"horizon": 30, "arrival_rate": 4.0, "mean_lifetime": 10.0, "mask": "feasible", "admission_control": True}
    return Scenario.from_config({**chosen, "substrate": substrate, **settings})


def full_scenario(**settings: Any) -> Scenario:
    """The same network with requests so large that some tens of them fill it."""
    bulk = {"chain": ["FW", "NAT"], "rate": 300.0, "tolerable_delay": 5000.0}
    bursts = {"chain": ["NAT", "FW", "NAT"], "rate": 500.0, "tolerable_delay": 8000.0}
    services = {"bulk": bulk, "bursts": bursts}
    return small_scenario(
        **{"mask": "adjacency", "horizon": 60, "mean_lifetime": 40.0, "services": services, **settings}
    )
