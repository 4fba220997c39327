"""Trained policies: written to files, and read back as methods that can be evaluated."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.losses.actors import q_network
from nfv_torchrl.methods.base import Method
from nfv_torchrl.methods.building import building, factory
from nfv_torchrl.methods.compiled import acting_method, fastest_method
from nfv_torchrl.methods.planned import planner_method
from nfv_torchrl.networks import Sizes
from nfv_torchrl.observations.candidates import count_features
from nfv_torchrl.scenario.scenario import MASKS, Scenario
from nfv_torchrl.scenario.together import fit_one_batch, play_apart
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.tensor_checks import check_keys, check_like, check_tensor
from nfv_torchrl.tensor_files import load_file, save_file

FORMAT = 2
FIRST_FORMAT = 1
"""Still read: it had no ``kind`` and no ``policy``, and kept an evolved policy under ``loss``."""
LARGEST = 10**9
"""Bytes of a policy file that is read; those of docs/results have some 50,000."""

KINDS: Mapping[str, tuple[str, ...]] = {
    "actor": ("network", "loss"),
    "planner": ("network", "loss", "planner"),
    "evolved": ("network", "policy"),
}
"""What a policy is, and the classes that it is built from: the actor of a loss that acts step by step, or that a
planner asks; or a policy that evolution found."""

PARTS = ("network", "loss", "planner", "policy")

KEYS: Mapping[str, type] = {
    "format": int,
    "kind": str,
    "weights": dict,
    "sizes": dict,
    "network": dict,
    "loss": dict,
    "planner": dict,
    "policy": dict,
    "one_hot": bool,
    "scenario": str,
    "mask": str,
    "admission_control": bool,
    "scores": dict,
}
"""What a policy file holds, and of which type it is. A part that does not belong to its kind is empty."""


def policy_content(
    module: nn.Module, sizes: Sizes, config: Mapping[str, Any], scenario: Scenario, scores: Mapping[str, float]
) -> dict[str, Any]:
    """What a policy file holds: what the policy is, weights, the classes they belong to, and where they come from.

    Args:
        module: a ``RequestLoss``, or an ``Evolvable``.
        sizes: sizes it was made for.
        config: the recipe's config: ``network``, with ``loss`` and ``env.planner``, if there is one that asks the
            policy, or with ``policy``, and ``one_hot``, are needed to build it again.
        scenario: what it was trained on.
        scores: numbers to keep beside it.
    """
    given = {**config, "planner": (config.get("env") or {}).get("planner")}
    parts = {part: dict(given.get(part) or {}) for part in PARTS}
    return {
        "format": FORMAT,
        "kind": _kind(parts),
        "weights": {name: tensor.detach().cpu().clone() for name, tensor in module.state_dict().items()},
        "sizes": dict(sizes._asdict()),
        **parts,
        "one_hot": bool(config.get("one_hot", False)),
        "scenario": scenario.name,
        "mask": scenario.mask,
        "admission_control": scenario.admission_control,
        "scores": dict(scores),
    }


def _kind(parts: Mapping[str, Any]) -> str:
    if parts["policy"]:
        return "evolved"
    return "planner" if parts["planner"] else "actor"


def save_policy(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write a policy file, all of it or nothing."""
    save_file(path, dict(content))


def load_policy(
    path: str | os.PathLike[str],
    scenario: Scenario | Sequence[Scenario],
    *,
    name: str = "checkpoint",
    trusted_packages: Sequence[str] = (),
    compiled: bool = False,
    planner: Mapping[str, Any] | None = None,
) -> Method:
    """The greedy policy of a file (``best.pt`` of a run) for ``scenario``.

    It acts under the mask that it was trained with, and may always reject if it could in training. A policy that was
    trained to be asked by a planner (NFVdeep) comes as that planner's method, an evolved one as the method that it
    makes of itself.

    The file may be anyone's: it is read without pickle, builds only the classes that ``methods/building.py`` lists,
    from plain arguments, and its weights have to be finite and of the shapes that these classes have.

    Args:
        path: the file.
        scenario: what it is to act on, one scenario or the several of one batch; networks of fixed size need the
            sizes they were trained on.
        name: name of the method in tables and folders.
        trusted_packages: packages of your own whose classes the file may name too. Importing them runs their code.
        compiled: decide without torch where the network allows it: the same decisions up to rounding, many times as
            fast. Decision times are then not those of the network through torch.
        planner: settings of the planner that asks the policy, in place of the file's: ``{"per_stay": 2.0}``.

    Raises:
        CheckpointError: unreadable, made for another network, or with anything in it that a policy has not.
    """
    content = _read(path)
    kind = content["kind"]
    if planner:
        content = {**content, "planner": _replaced(path, content["planner"], planner)}
    make = {part: factory(path, part, content[part], trusted_packages) for part in KINDS[kind]}
    given = [scenario] if isinstance(scenario, Scenario) else scenario
    scenarios = given[:1] if play_apart(given) else fit_one_batch(given)
    simulator = Simulator(scenarios, len(scenarios), one_hot=content["one_hot"])
    with building(path, content["weights"]):
        asking = make["planner"]() if kind == "planner" else None
        sizes = asking.sizes(simulator) if asking else _as_trained(Sizes.of(simulator), content, make["network"])
        module = make["policy" if kind == "evolved" else "loss"](network=make["network"], sizes=sizes)
        network = module.network if kind == "evolved" else q_network(module)
    _check_fit(path, content, sizes, network, scenarios[0])
    check_like(path, "weights", content["weights"], module.state_dict())
    module.load_state_dict(content["weights"])
    if kind == "evolved":
        return module.eval().method(name)
    module.actor.eval()
    if asking:
        return planner_method(asking.follow(module.actor), name=name)
    acting = fastest_method if compiled else acting_method
    return acting(
        module.actor,
        network,
        one_hot=content["one_hot"],
        name=name,
        mask=content["mask"],
        decides_admission=content["admission_control"],
    )


def _replaced(path: str | os.PathLike[str], own: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A planner's settings with some replaced; its class stays."""
    if not own or "_target_" in settings:
        raise CheckpointError(
            f"{path}: planner={dict(settings)}: only the settings of a planner's policy can be replaced"
        )
    return {**own, **settings}


def _as_trained(sizes: Sizes, content: Mapping[str, Any], network: Callable) -> Sizes:
    """``sizes`` with what a policy keeps of its training: rows of candidates with columns on the request itself or
    without, and the number of services, where the network knows none (the loss may: of mean rewards, say)."""
    trained = content["sizes"]
    known = {count_features(trained["services"], request=request) for request in (False, True)}
    if getattr(getattr(network, "func", network), "any_services", False):
        sizes = sizes._replace(services=trained["services"])
    if trained["services"] == sizes.services and trained["candidate_features"] in known:
        sizes = sizes._replace(candidate_features=trained["candidate_features"])
    return sizes


def _check_fit(
    path: str | os.PathLike[str], content: Mapping[str, Any], sizes: Sizes, network: Any, scenario: Scenario
) -> None:
    """Refuse a scenario of other sizes, unless the network fits any."""
    trained = Sizes(**content["sizes"])
    if content["kind"] == "planner" and trained.candidate_features != sizes.candidate_features:
        ways = ("by what they ask", "by their service")
        there, here = ways if trained.candidate_features else reversed(ways)
        raise CheckpointError(
            f"{path} was trained on {content['scenario']}, where menus describe requests {there}; those of "
            f"{scenario.name} are described {here}. Train on such requests"
        )
    if trained != sizes and not (network.any_size and trained.services == sizes.services):
        raise CheckpointError(
            f"{path} was trained on {content['scenario']} with {trained.actions} actions and {trained.observation} "
            f"observations, and {trained.services} services; {scenario.name} has {sizes.actions}, {sizes.observation} "
            f"and {sizes.services}. Evaluate it on the scenario (and scenario.seed sizes) it was trained on, or train "
            "with network=candidate, which fits any size, or network=lookahead, which also fits any services"
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
    """The content of a policy file, each entry of the type it has to be; nothing is built of it.

    Raises:
        CheckpointError: unreadable, of another format, or with an entry missing or of another type.
    """
    content = load_file(path, largest=LARGEST)
    if "format" not in content and "config" in content:
        raise CheckpointError(f"{path} is a checkpoint to go on with, not a policy; give the best.pt beside it")
    if type(content.get("format")) is not int or content["format"] not in (FIRST_FORMAT, FORMAT):
        raise CheckpointError(f"{path} is not a policy file of this version; its format is not {FORMAT}")
    if content["format"] == FIRST_FORMAT:
        _check_types(path, content, {key: kind for key, kind in KEYS.items() if key not in ("kind", "policy")})
        content = _renewed(content)
    _check_types(path, content, KEYS)
    for key, tensor in content["weights"].items():
        if not isinstance(key, str) or not isinstance(tensor, Tensor):
            raise CheckpointError(f"{path}: weights.{key} is a {type(tensor).__name__}, not a tensor")
    for key, score in content["scores"].items():
        if type(score) not in (int, float):
            raise CheckpointError(f"{path}: scores.{key} is a {type(score).__name__}, not a number")
    check_like(path, "sizes", content["sizes"], dict.fromkeys(Sizes._fields, 0))
    for key, known in (("mask", MASKS), ("kind", KINDS)):
        if content[key] not in known:
            raise CheckpointError(f"{path}: {key} is {content[key]!r:.60}; it has to be one of {', '.join(known)}")
    more = [part for part in PARTS if content[part] and part not in KINDS[content["kind"]]]
    if more:
        raise CheckpointError(f"{path}: {more[0]} belongs to no policy of kind {content['kind']}; it has to be empty")
    return content


def _check_types(path: str | os.PathLike[str], content: Mapping[str, Any], types: Mapping[str, type]) -> None:
    check_keys(path, "a policy file", content, types)
    for key, kind in types.items():
        if type(content[key]) is not kind:
            found = type(content[key]).__name__
            raise CheckpointError(f"{path}: {key} is a {found}, not a {kind.__name__}; it is no policy file")


def _renewed(content: Mapping[str, Any]) -> dict[str, Any]:
    """A file of the first format as one of this."""
    parts = {**{part: content[part] for part in PARTS if part != "policy"}, "policy": {}}
    if str(parts["loss"].get("_target_")).startswith("nfv_torchrl.evolution."):
        parts |= {"policy": parts["loss"], "loss": {}}
    return {**content, **parts, "kind": _kind(parts), "format": FORMAT}
