"""What an evaluation runs: anything that answers B networks step by step, be it a rule, a planner or a trained policy.

A method of your own is any class with the attributes of ``Method``; in a recipe's yaml it is a ``_target_``.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from hydra.utils import instantiate
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor, QValueActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.observations import ObservationPart, read_observation
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel

TABLES = ("summary.csv", "per_seed.csv")
"""Files beside the folders that are called after methods."""


class Method(Protocol):
    """Decides for every environment of a simulator, one step of its walk at a time.

    Attributes:
        name: what tables and folders call it.
        decides_admission: it refuses by itself: its run has ``admission_control`` on, so that ``reject`` is always
            valid (reason ``rejected_by_policy``). False: as the scenario says.
        mask: the mask of its run (``adjacency`` or ``feasible``), None: as the scenario says.
        one_hot: whether the flat observation of its run ends with the one-hot request features.
    """

    name: str
    decides_admission: bool
    mask: str | None
    one_hot: bool

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """Called once before a run, when all horizons have begun. ``seeds`` [B]: the workload seed of each environment.

        The place to compile, allocate and seed: what happens here is not counted as decision time. Whatever was
        carried from step to step in an earlier run is dropped.
        """

    def act(self, simulator: Simulator) -> np.ndarray:
        """The next action of every environment, int64 [B]; it does not matter for one past its horizon."""


@kernel
def pick_uniform(env, valid, states, actions):
    """One of the valid actions of every environment; ``states`` uint64 [B] (xorshift, never 0) are advanced."""
    for b in range(actions.size):
        x = states[b]
        x ^= x << np.uint64(13)
        x ^= x >> np.uint64(7)
        x ^= x << np.uint64(17)
        states[b] = x
        actions[b] = valid[b, np.int64((x >> np.uint64(33)) % np.uint64(env[b].mask_count))]


class RandomMethod:
    """``random``: uniform over the mask; ``random_feasible`` with ``mask="feasible"``.

    Each environment draws from a generator of its workload seed, so that a run does not depend on which others are
    made together with it.
    """

    decides_admission = False
    one_hot = False

    def __init__(self, *, name: str = "random", mask: str | None = None) -> None:
        self.name, self.mask = name, mask

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        states = [generator(seed, Stream.EXPLORATION).integers(1, 2**63) for seed in seeds]
        self._states = np.array(states, np.uint64)
        none = np.zeros(0, np.int64)
        pick_uniform(simulator.world.env, simulator.world.seen.valid, self._states, none)

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        actions = np.empty(simulator.batch_size, np.int64)
        pick_uniform(simulator.world.env, simulator.world.seen.valid, self._states, actions)
        return actions


class PlannerMethod:
    """A planner that plans each request when it arrives and then plays its plan action by action.

    A request without an embedding, or refused by the planner, is answered with ``reject``.
    """

    decides_admission = True
    mask: str | None = None
    one_hot = False

    def __init__(self, planner: Planner, *, name: str) -> None:
        self.planner, self.name = planner, name

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._rows = np.arange(simulator.batch_size)
        self._plans = np.zeros((simulator.batch_size, simulator.world.rules.max_steps), np.int64)
        self._lengths = np.zeros(simulator.batch_size, np.int64)
        self.planner.prepare(simulator.world)
        # A compiled planner compiles with its first call, be there nothing to plan.
        self.planner.plan_rows(simulator.world, self._rows[:0], self._plans, self._lengths)

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        env = simulator.world.env
        steps = env["steps"]
        fresh = np.flatnonzero((steps == 0) & (env["done"] == 0))
        if fresh.size:
            self.planner.plan_rows(simulator.world, fresh, self._plans, self._lengths)
        reject = simulator.num_actions - 1
        return np.where(steps < self._lengths, self._plans[self._rows, steps], reject)


class PolicyMethod:
    """The greedy actions of a TorchRL actor.

    Args:
        actor: reads the keys of ``NFVEnv`` that it was trained on, writes ``action`` int64 [B]. What it writes below
            ``next`` (a recurrent state) is given back to it with the next step.
        parts: the parts of the observation that it reads, as given to ``NFVEnv``.
        name: what tables and folders call it.
        one_hot: as given to ``NFVEnv``.
        mask: the mask that it was trained with, None: the scenario's.
        decides_admission: whether it was trained with ``admission_control`` while the scenario may not have it.
        device: where the actor lives.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        parts: Sequence[ObservationPart] = (),
        *,
        name: str = "policy",
        one_hot: bool = True,
        mask: str | None = None,
        decides_admission: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        self.actor, self.name, self.parts, self.one_hot = actor, name, tuple(parts), one_hot
        self.mask, self.decides_admission, self.device = mask, decides_admission, device
        self._scorer = scorer(actor)
        self._carried: TensorDictBase | None = None

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._carried = None
        self.act(simulator)  # the first call allocates and may compile
        self._carried = None

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        if self._scorer is not None:
            return self._highest(simulator, self._scorer)
        seen = read_observation(simulator, self.parts)
        if self.device is not None:
            seen = seen.to(self.device)
        if self._carried is not None:
            seen.update(self._carried)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            answer = self.actor(seen)
        self._carried = answer.get("next", None)
        return answer.get("action").cpu().numpy()

    def _highest(self, simulator: Simulator, scores: TensorDictModule) -> np.ndarray:
        """The valid action of the highest score; without the actor's own bookkeeping, a step costs half as much."""
        view = simulator.world.seen
        mask = torch.from_numpy(view.mask)
        seen: dict[str, Any] = {"observation": torch.from_numpy(view.flat), "action_mask": mask}
        for part in self.parts:
            seen.update(part.read(simulator))
        inputs = [_take(seen, key) for key in scores.in_keys]
        if self.device is not None:
            inputs = [value.to(self.device) for value in inputs]
        with torch.no_grad():
            values = scores.module(*inputs).cpu()
        return values.masked_fill(~mask, -torch.inf).argmax(-1).numpy()


def scorer(actor: TensorDictModuleBase) -> TensorDictModule | None:
    """The module of an actor whose scores decide: its greedy action is the valid one of the highest score.

    None for an actor of another kind, or with a memory.
    """
    stochastic = isinstance(actor, ProbabilisticActor) and actor[-1].distribution_class is MaskedCategorical
    if not (stochastic or isinstance(actor, QValueActor)):
        return None
    scores = actor[0]
    return scores if type(scores) is TensorDictModule and len(scores.out_keys) == 1 else None


def _take(seen: Mapping[str, Any], key: str | tuple[str, ...]) -> torch.Tensor:
    """The value of a key, nested or not."""
    if isinstance(key, str):
        return seen[key]
    nested: TensorDict = seen[key[0]]
    return nested.get(key[1:])


def _check_name(key: str, name: Any, others: Iterable[str]) -> None:
    """A method's name is that of a folder, too, on any file system."""
    usable = isinstance(name, str) and name.isprintable() and name.strip() == name and len(name.encode()) <= 100
    if not usable or not name or name[0] == "." or any(letter in name for letter in "/\\:"):
        raise ScenarioError(
            f"method.{key}.name: {name!r} names no folder of its own; use letters and digits, no slash, no dot in front"
        )
    alike = [other for other in (*others, *TABLES) if other != name and other.casefold() == name.casefold()]
    if alike or name in TABLES:
        raise ScenarioError(f"method.{key}.name: {name!r} and {(alike or TABLES)[0]!r} are one file; use another name")


def methods_from_config(config: Mapping[str, Any], scenario: Scenario | Sequence[Scenario]) -> list[Method]:
    """Build the methods of a recipe's ``method`` group, in order.

    Args:
        config: ``_target_`` and arguments of each method; the keys only tell the entries apart. An entry with
            ``_partial_: true`` is called with ``scenario=`` after that (a checkpoint has to be checked against it).
        scenario: what the methods will run on, one scenario or the several of one batch.

    Raises:
        ScenarioError: an entry is no method, or two have the same name.
    """
    methods: dict[str, Method] = {}
    for key, entry in config.items():
        if not isinstance(entry, Mapping) or "_target_" not in entry:
            raise ScenarioError(f"method.{key}: {entry!r} is no method; give _target_ and the arguments of its class")
        method = instantiate(entry)
        if isinstance(method, functools.partial):
            method = method(scenario=scenario)
        lacking = [name for name in (*Method.__annotations__, "prepare", "act") if not hasattr(method, name)]
        if lacking:
            raise ScenarioError(f"method.{key}: {type(method).__name__} lacks {lacking[0]!r}; see evaluation.Method")
        _check_name(key, method.name, methods)
        if method.name in methods:
            raise ScenarioError(f"method.{key}: another method is called {method.name!r} too; set method.{key}.name")
        methods[method.name] = method
    if not methods:
        raise ScenarioError("method: names no method; give at least one, such as method=greedy")
    return list(methods.values())
