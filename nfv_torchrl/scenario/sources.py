"""Where a substrate comes from: a random graph, a file, a topology that ships here, or a user's own generator."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import SubstrateConfig
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.resources import ResourceRanges
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.topology_zoo import read_topology


def build_substrate(config: SubstrateConfig, seed: int) -> Substrate:
    """The substrate that ``config`` describes, drawn with scenario seed ``seed``.

    ``path`` is read, what it lacks is drawn; ``generator`` is called; with neither the graph is random. ``target_rho``
    is the scenario's to apply.

    Raises:
        ScenarioError: a value or a file that cannot be used.
    """
    if config.path is not None and config.generator is not None:
        raise ScenarioError("substrate: both path and generator are set; keep one and set the other to null")
    if config.path is None and config.attributes:
        raise ScenarioError("substrate.attributes: names attributes of a file, but there is none; set substrate.path")
    if config.generator is not None:
        return _with_duplex(_call_generator(config.generator, seed), config.duplex)
    names = [field.name for field in fields(ResourceRanges) if field.name != "vms"]
    ranges: dict[str, Any] = {"vms": (config.vms_min, config.vms_max)} | {name: getattr(config, name) for name in names}
    if config.path is None:
        random = draw_random_substrate(config.nodes, seed, mean_degree=config.mean_degree, **ranges)
        return _with_duplex(random, config.duplex)
    substrate = read_topology(
        config.path,
        seed,
        fibre_km_per_ms=config.fibre_km_per_ms,
        detour=config.detour,
        largest_component=config.largest_component,
        directed=config.directed,
        attributes=config.attributes,
        **ranges,
    )
    return _with_duplex(substrate, config.duplex)


def _with_duplex(substrate: Substrate, duplex: str | None) -> Substrate:
    """The substrate with links as ``duplex`` has them, see ``SubstrateConfig``."""
    if duplex == "shared" and substrate.full_duplex:
        raise ScenarioError(
            f"substrate.duplex: shared, but links of {substrate.name!r} have a back_capacity; leave it out, or remove "
            "these from the file"
        )
    if duplex == "full" and not substrate.full_duplex:
        return dataclasses.replace(substrate, back_capacity=substrate.link_capacity)
    return substrate


def _call_generator(config: Mapping[str, Any], seed: int) -> Substrate:
    """What the user's callable named by ``_target_`` returns when called with ``seed`` and the other keys."""
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    target = config.get("_target_")
    if not target:
        raise ScenarioError("substrate.generator: needs _target_, such as my_package.my_module.my_generator")
    try:
        substrate = instantiate(dict(config), seed=seed)
    except InstantiationException as error:
        if isinstance(error.__cause__, ScenarioError):
            raise error.__cause__ from error
        raise ScenarioError(f"substrate.generator: {target} cannot be called: {error}") from error
    if not isinstance(substrate, Substrate):
        raise ScenarioError(
            f"substrate.generator: {target} returned a {type(substrate).__name__}; it must return a "
            "nfv_torchrl.scenario.Substrate (Substrate.from_networkx makes one)"
        )
    return substrate
