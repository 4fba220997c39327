"""Trained policies as files, and back as methods that can be evaluated."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.utils import instantiate
from torch import nn

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.methods import Method, PlannerMethod
from nfv_torchrl.networks import QNetwork, Sizes
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.acting import acting_method
from nfv_torchrl.training.checkpoint import load_file, save_file

FORMAT = 1


def policy_content(
    loss: nn.Module, sizes: Sizes, config: Mapping[str, Any], scenario: Scenario, scores: Mapping[str, float]
) -> dict[str, Any]:
    """What a policy file holds: weights, the network and loss they belong to, and where they come from.

    Args:
        loss: a ``RequestLoss``.
        sizes: sizes it was made for.
        config: the recipe's config: ``network``, ``loss``, ``one_hot`` and ``planner``, if there is one that asks the
            policy, are needed to build it again.
        scenario: what it was trained on.
        scores: numbers to keep beside it.
    """
    return {
        "format": FORMAT,
        "weights": {name: tensor.detach().cpu().clone() for name, tensor in loss.state_dict().items()},
        "sizes": dict(sizes._asdict()),
        "network": dict(config["network"]),
        "loss": dict(config["loss"]),
        "one_hot": bool(config.get("one_hot", False)),
        "planner": dict(config.get("planner") or {}),
        "scenario": scenario.name,
        "mask": scenario.mask,
        "admission_control": scenario.admission_control,
        "scores": dict(scores),
    }


def save_policy(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write a policy file, all of it or nothing."""
    save_file(path, dict(content))


def load_policy(
    path: str | os.PathLike[str],
    scenario: Scenario | Sequence[Scenario],
    *,
    name: str = "checkpoint",
    trusted_packages: Sequence[str] = (),
) -> Method:
    """The greedy policy of a file (``best.pt`` or a full checkpoint of a run) for ``scenario``.

    It acts under the mask that it was trained with, and may always reject if it could in training. A policy that was
    trained to be asked by a planner (NFVdeep) comes as that planner's method. What stands in for a loss in the file
    (the policies of ``evolution``) says by its own ``method(name)`` how it acts.

    Args:
        path: the file.
        scenario: what it is to act on, one scenario or the several of one batch; networks of fixed size need the
            sizes they were trained on.
        name: name of the method in tables and folders.
        trusted_packages: a policy file names the classes of its network and loss. Those of this project are built as
            they are; others only from packages named here, because building an object runs its code.

    Raises:
        CheckpointError: unreadable, made for another network, or of a package that is not trusted.
    """
    content = load_file(path)
    content = content.get("policy", content)
    if content.get("format") != FORMAT:
        raise CheckpointError(f"{path} is not a policy file of this version (format {content.get('format')!r})")
    for part in ("network", "loss", "planner"):
        _check_target(path, content[part], trusted_packages)
    network = instantiate(content["network"])
    scenarios = [scenario] if isinstance(scenario, Scenario) else list(scenario)
    simulator = Simulator(scenarios, len(scenarios), one_hot=content["one_hot"])
    planner = instantiate(content["planner"])
    sizes = planner.sizes(simulator) if planner else Sizes.of(simulator)
    loss = instantiate(content["loss"], network=network, sizes=sizes)
    module = q_network(loss)
    trained = Sizes(**content["sizes"])
    fits = trained == sizes or (module.any_size and trained.services == sizes.services)
    if not fits:
        raise CheckpointError(
            f"{path} was trained on {content['scenario']} with {trained.actions} actions and {trained.observation} "
            f"observations; {scenarios[0].name} has {sizes.actions} and {sizes.observation}. Evaluate it on the "
            "scenario (and scenario.seed sizes) it was trained on, or train with network=candidate, which fits any size"
        )
    loss.load_state_dict(content["weights"])
    loss.actor.eval()
    if hasattr(loss, "method"):
        return loss.method(name)
    if planner:
        return PlannerMethod(planner.follow(loss.actor), name=name)
    return acting_method(
        loss.actor,
        module,
        one_hot=content["one_hot"],
        name=name,
        mask=content["mask"],
        decides_admission=content["admission_control"],
    )


def load_weights(network: nn.Module, path: str | os.PathLike[str]) -> None:
    """Set the weights of a network to those in a policy file, whatever loss or recipe trained them.

    Args:
        network: a network such as the file's.
        path: the policy file.

    Raises:
        CheckpointError: unreadable, or its network has other weights than this one.
    """
    content = load_file(path)
    weights = content.get("policy", content).get("weights", {})
    own = network.state_dict()
    # Losses keep their networks under names of their own; the end of a name is the network's.
    found = {name: next((value for key, value in weights.items() if _is_weight(key, name)), None) for name in own}
    for name, value in found.items():
        if value is None or value.shape != own[name].shape:
            theirs = "nothing" if value is None else list(value.shape)
            raise CheckpointError(
                f"{path} has {theirs} where this network has {name} {list(own[name].shape)}; give the settings of "
                "network= that the file was trained with"
            )
    network.load_state_dict(found)


def _is_weight(key: str, name: str) -> bool:
    return not key.startswith("target_") and f".{key}".endswith(f".{name}")


def q_network(loss: Any) -> QNetwork:
    """The Q-network inside a loss's actor, or what takes its place there and says whether it fits any size."""
    modules = list(loss.actor.modules())
    # The network itself first: TensorDict's modules pass on the attributes of what they hold.
    for module in (*(each for each in modules if isinstance(each, QNetwork)), *modules):
        if isinstance(module, QNetwork) or hasattr(module, "any_size"):
            return module
    raise CheckpointError("the loss's actor holds no QNetwork; derive the network from nfv_torchrl.networks.QNetwork")


def _check_target(path: Any, config: Any, trusted_packages: Sequence[str]) -> None:
    """Refuse a config that would call anything outside the trusted packages, at any depth."""
    if isinstance(config, list | tuple):
        for item in config:
            _check_target(path, item, trusted_packages)
    if not isinstance(config, Mapping):
        return
    target = str(config.get("_target_", ""))
    if target and target.split(".")[0] not in {"nfv_torchrl", *trusted_packages}:
        raise CheckpointError(
            f"{path} asks for {target}, which is not part of this project; if you trust it, name its package in "
            "trusted_packages"
        )
    for value in config.values():
        _check_target(path, value, trusted_packages)
