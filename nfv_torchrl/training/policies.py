"""Trained policies as files, and back as methods that can be evaluated."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.methods import Method, PlannerMethod
from nfv_torchrl.networks import QNetwork, Sizes
from nfv_torchrl.scenario.scenario import MASKS, Scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.acting import acting_method
from nfv_torchrl.training.building import building, factory
from nfv_torchrl.training.checking import check_keys, check_like, check_tensor
from nfv_torchrl.training.checkpoint import load_file, save_file

FORMAT = 1
LARGEST = 10**9
"""Bytes of a policy file that is read; those of docs/results have some 50,000."""

KEYS: Mapping[str, type] = {
    "format": int,
    "weights": dict,
    "sizes": dict,
    "network": dict,
    "loss": dict,
    "one_hot": bool,
    "planner": dict,
    "scenario": str,
    "mask": str,
    "admission_control": bool,
    "scores": dict,
}
"""What a policy file holds, and of which kind it is."""


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
        "planner": dict((config.get("env") or {}).get("planner") or {}),
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
    """The greedy policy of a file (``best.pt`` of a run) for ``scenario``.

    It acts under the mask that it was trained with, and may always reject if it could in training. A policy that was
    trained to be asked by a planner (NFVdeep) comes as that planner's method. What stands in for a loss in the file
    (the policies of ``evolution``) says by its own ``method(name)`` how it acts.

    The file may be anyone's: it is read without pickle, builds only the classes that ``training/building.py`` lists,
    from plain arguments, and its weights have to be finite and of the shapes that these classes have.

    Args:
        path: the file.
        scenario: what it is to act on, one scenario or the several of one batch; networks of fixed size need the
            sizes they were trained on.
        name: name of the method in tables and folders.
        trusted_packages: packages of your own whose classes the file may name too. Importing them runs their code.

    Raises:
        CheckpointError: unreadable, made for another network, or with anything in it that a policy has not.
    """
    content = _read(path)
    network = factory(path, "network", content["network"], trusted_packages)
    make_loss = factory(path, "loss", content["loss"], trusted_packages)
    make_planner = factory(path, "planner", content["planner"], trusted_packages) if content["planner"] else None
    scenarios = [scenario] if isinstance(scenario, Scenario) else list(scenario)
    simulator = Simulator(scenarios, len(scenarios), one_hot=content["one_hot"])
    with building(path, content["weights"]):
        planner = make_planner() if make_planner else None
        sizes = planner.sizes(simulator) if planner else Sizes.of(simulator)
        loss = make_loss(network=network, sizes=sizes)
        module = q_network(loss)
    trained = Sizes(**content["sizes"])
    fits = trained == sizes or (module.any_size and trained.services == sizes.services)
    if not fits:
        raise CheckpointError(
            f"{path} was trained on {content['scenario']} with {trained.actions} actions and {trained.observation} "
            f"observations; {scenarios[0].name} has {sizes.actions} and {sizes.observation}. Evaluate it on the "
            "scenario (and scenario.seed sizes) it was trained on, or train with network=candidate, which fits any size"
        )
    check_like(path, "weights", content["weights"], loss.state_dict())
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
    weights = _read(path)["weights"]
    own = network.state_dict()
    # Losses keep their networks under names of their own; the end of a name is the network's.
    found = {name: next((key for key in weights if _is_weight(key, name)), None) for name in own}
    for name, key in found.items():
        if key is None or weights[key].shape != own[name].shape:
            theirs = "nothing" if key is None else list(weights[key].shape)
            raise CheckpointError(
                f"{path} has {theirs} where this network has {name} {list(own[name].shape)}; give the settings of "
                "network= that the file was trained with"
            )
        check_tensor(path, f"weights.{key}", weights[key], own[name])
    network.load_state_dict({name: weights[key] for name, key in found.items() if key is not None})


def _is_weight(key: str, name: str) -> bool:
    return not key.startswith("target_") and f".{key}".endswith(f".{name}")


def _read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a policy file, each entry of the kind it has to be; nothing is built of it.

    Raises:
        CheckpointError: unreadable, of another format, or with an entry missing or of another kind.
    """
    content = load_file(path, largest=LARGEST)
    if "format" not in content and "config" in content:
        raise CheckpointError(f"{path} is a checkpoint to go on with, not a policy; give the best.pt beside it")
    if type(content.get("format")) is not int or content["format"] != FORMAT:
        raise CheckpointError(f"{path} is not a policy file of this version; its format is not {FORMAT}")
    check_keys(path, "a policy file", content, KEYS)
    for key, kind in KEYS.items():
        if type(content[key]) is not kind:
            found = type(content[key]).__name__
            raise CheckpointError(f"{path}: {key} is a {found}, not a {kind.__name__}; it is no policy file")
    for key, tensor in content["weights"].items():
        if not isinstance(key, str) or not isinstance(tensor, Tensor):
            raise CheckpointError(f"{path}: weights.{key} is a {type(tensor).__name__}, not a tensor")
    for key, score in content["scores"].items():
        if type(score) not in (int, float):
            raise CheckpointError(f"{path}: scores.{key} is a {type(score).__name__}, not a number")
    check_like(path, "sizes", content["sizes"], dict.fromkeys(Sizes._fields, 0))
    if content["mask"] not in MASKS:
        raise CheckpointError(f"{path}: mask is {content['mask']!r:.60}; it has to be one of {', '.join(MASKS)}")
    return content


def q_network(loss: Any) -> QNetwork:
    """The Q-network inside a loss's actor, or what takes its place there and says whether it fits any size."""
    modules = list(loss.actor.modules())
    # The network itself first: TensorDict's modules pass on the attributes of what they hold.
    for module in (*(each for each in modules if isinstance(each, QNetwork)), *modules):
        if isinstance(module, QNetwork) or hasattr(module, "any_size"):
            return module
    raise CheckpointError("the loss's actor holds no QNetwork; derive the network from nfv_torchrl.networks.QNetwork")
