"""The cells of a study: which methods run on which scenario, with how many seeds and how much training."""

from __future__ import annotations

import copy
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.errors import HydraException
from omegaconf import OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.experiments.cells import Cell, make_cell
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.training.cli import recipe_configs

Point = dict[str, Any]
"""The keys of a scenario's yaml, all of them."""
PLACES = {"nodes": ("substrate", "nodes")}
"""Where a changed value is, if not at the top."""
Runs = tuple[Cell, ...]
"""The cells that together hold a method on all workload seeds."""
AGENT = "dqn_ar"
"""The paper's agent, which learning curves and rewards are about."""
HASTY = "quick"
"""The budget with which agents hardly learn."""
SHORT = {"nodes": "N", "arrival_rate": "λ", "mean_lifetime": "μ"}
NO_MATTER = ("scenario", "run_dir", "resume", "device", "logger", "saving")


def cells_of(evaluations: Mapping[Any, Runs]) -> list[Cell]:
    """All cells of some evaluations."""
    return [cell for runs in evaluations.values() for cell in runs]


class Study:
    """Makes cells from the config of ``recipes/figures.py``, which is in the folder ``recipes``.

    Attributes:
        base: the scenario from which sweeps start.
        budget: the numbers of ``config/budget``.
        planners: methods that need no training, by name.
        trained: methods that do, by name.
        seeds: workload seeds.
    """

    def __init__(self, config: Mapping[str, Any], recipes: Path) -> None:
        self._recipes = recipes.resolve()
        self.base: Point = config["scenario"]
        self.budget: dict[str, Any] = config["budget"]
        self.planners: dict[str, Any] = config["method"]
        self.trained: dict[str, Any] = config["trained"]
        self.rewards: dict[str, Any] = config["rewards"]
        self.colocations: list[bool] = config["colocation"]
        self.seeds = list(range(self.budget["seeds"]))
        self._rho: dict[str, float] = {}
        self._configs: dict[tuple[str, tuple[str, ...]], dict[str, Any]] = {}
        self._mask: str | None = None

    def world(self, **changes: Any) -> Point:
        """The base scenario with ``changes`` (``nodes`` is the substrate's).

        Raises:
            ScenarioError: the number of nodes shall change, but the network is a given one.
        """
        given = next((key for key in ("path", "generator") if self.base["substrate"][key] is not None), None)
        if "nodes" in changes and given is not None:
            raise ScenarioError(f"substrate.{given}: the figures over N draw random networks; leave it null for them")
        world = copy.deepcopy(self.base)
        for key, value in changes.items():
            place = world
            for step in PLACES.get(key, (key,))[:-1]:
                place = place[step]
            place[PLACES.get(key, (key,))[-1]] = value
        return world

    def rho(self, world: Point) -> float:
        """Offered load of a scenario."""
        key = json.dumps(world, sort_keys=True)
        if key not in self._rho:
            self._rho[key] = Scenario.from_config(world).offered_load()
        return self._rho[key]

    def methods(self, world: Point) -> list[str]:
        """The methods compared on a scenario; those trained for each scenario only where the budget trains for it."""
        agents = [name for name in self.trained if self.is_general(name) or self._trains_for(world)]
        return [*agents, *self.planners]

    def is_general(self, name: str) -> bool:
        """Whether a method is trained once, for all scenarios."""
        return name in self.trained and self.trained[name].get("once") is not None

    def _trains_for(self, world: Point) -> bool:
        """Whether the colocation, and each value named in ``trained_points``, are of those that agents train for."""
        if world["colocation"] not in self.budget["trained_colocation"]:
            return False
        values = {"nodes": world["substrate"]["nodes"], **world}
        points = self.budget["trained_points"]
        return all(points[key] is None or values[key] in points[key] for key in points)

    def evaluations(self, world: Point) -> dict[str, Runs]:
        """An evaluation of every method on a scenario."""
        return {name: self.evaluation(name, world) for name in self.methods(world)}

    def evaluation(self, name: str, world: Point, reward: Sequence[str] | None = None) -> Runs:
        """A method on all seeds of a scenario; ``reward``: see ``training``.

        Of a method that is trained once, each training seed answers its share of the workload seeds, so that an
        interval over these holds the differences between trainings, too.
        """
        if not self.is_general(name):
            return (self._run("evaluation", name, world, self.seeds, self._trained(name, world, reward)),)
        count = min(self.budget["training_seeds"], len(self.seeds))
        return tuple(
            self._run("evaluation", name, world, self.seeds[seed::count], self._trained(name, world, reward, seed))
            for seed in range(count)
        )

    def timing(self, name: str, world: Point) -> Cell:
        """A method's decision time, on scenarios cut short. A trained method has the policy of the whole horizon."""
        options = self.budget["timing"]
        short = world | {"horizon": min(world["horizon"], options["horizon"])}
        return self._run("timing", name, short, list(range(options["seeds"])), self._trained(name, world))

    def bound(self, world: Point, seeds: Sequence[int] | None = None) -> Cell:
        """Upper bounds on AAR, of the workloads of all seeds or of ``seeds``."""
        spec = {"scenario": world, "seeds": self.seeds if seeds is None else list(seeds)}
        return make_cell("bound", _label("bound", world), spec)

    def presence(self, world: Point, slots: Sequence[int]) -> Cell:
        """How long users stay."""
        spec = {"scenario": world, "seeds": self.seeds, "slots": list(slots)}
        return make_cell("presence", _label("presence", world), spec)

    def training(self, name: str, world: Point, reward: Sequence[str] | None = None, seed: int = 0) -> Cell:
        """The training of a method on a scenario.

        Args:
            name: one of ``trained``.
            world: the scenario; a method that is trained once has one of its own.
            reward: overrides of the recipe that say what is rewarded, for the agent; by default those of its default
                reward.
            seed: of the training.
        """
        if name not in self.trained:
            raise ScenarioError(f"trained: has no {name!r}, which this figure shows; add it or ask for other figures")
        method = self.trained[name]
        if self.is_general(name):
            world = self.world(**{key: value for key, value in method["once"].items() if value is not None})
        overrides = [*method["overrides"], f"seed={seed}"]
        if name == AGENT:
            overrides += self.reward("default") if reward is None else reward
        spec = {
            "recipe": method["recipe"],
            "policy": method["policy"],
            "overrides": sorted(overrides),
            "config": self._config(name, tuple(sorted(overrides))),  # so that a changed preset is another training
            "scenario": world,
        }
        return make_cell("training", _label(f"train_{name}", world), spec)

    def reward(self, name: str, w_cost: float | None = None) -> list[str]:
        """The overrides of one of ``rewards``, with its own cost weight or another."""
        reward = self.rewards[name]
        return [*reward["overrides"], f"reward.w_cost={float(reward['w_cost'] if w_cost is None else w_cost)}"]

    def _config(self, name: str, overrides: tuple[str, ...]) -> dict[str, Any]:
        """What the recipe makes of its overrides, but for its scenario and what changes no result."""
        if (name, overrides) not in self._configs:
            recipe = self.trained[name]["recipe"]
            try:
                with recipe_configs(self._recipes):
                    composed = compose(Path(recipe).stem, list(overrides))
            except HydraException as error:
                raise ScenarioError(f"trained.{name}.overrides: {recipe} refuses them: {error}") from error
            config: Any = OmegaConf.to_container(composed, resolve=True)
            if name == AGENT:
                self._mask = config["scenario"]["mask"]
            self._configs[name, overrides] = {key: config[key] for key in config if key not in NO_MATTER}
        return self._configs[name, overrides]

    def about(self, agents: Collection[str] | None = None, over: str | None = None) -> str:
        """What every caption says: the effort behind the figure, and where agents are missing and why.

        Args:
            agents: the trained methods that the figure shows, where there are any; null: all.
            over: what means and intervals are over; null: the workload seeds.
        """
        budget = self.budget
        seeds = over or (f"{len(self.seeds)} workload seeds" if len(self.seeds) > 1 else "1 workload seed")
        seen = "seen" if self.base["observe_lifetime"] else "hidden"
        told = [
            f"Budget {budget['name']}: {seeds} (bars and bands: 95 % intervals), scenario seed {self.base['seed']}, "
            f"T = {self.base['horizon']} s, lifetimes {seen}."
        ]
        wanted = self.trained if agents is None else agents
        general = [name for name in wanted if self.is_general(name)]
        each = [name for name in wanted if name in self.trained and name not in general] if self._trains() else []
        if not general and not each:
            return " ".join(told)
        preview = (
            "PREVIEW: agents have hardly learnt; use budget=full to judge them.\n" if budget["name"] == HASTY else ""
        )
        frames = ", ".join(f"{show(name)} {n:,}" for name, n in budget["frames"].items() if name in (*general, *each))
        told += [f"Training frames: {frames}.", *self._about_general(general), *self._about_each(each)]
        return preview + " ".join(told)

    def _trains(self) -> bool:
        return bool(self.budget["trained_colocation"])

    def _about_general(self, names: Sequence[str]) -> list[str]:
        if not names:
            return []
        count = min(self.budget["training_seeds"], len(self.seeds))
        seeds = f"{count} training seeds, which share the workloads" if count > 1 else "1 training seed"
        return [f"{_together(names)}: trained once, on random networks ({seeds})."]

    def _about_each(self, names: Sequence[str]) -> list[str]:
        budget, told = self.budget, []
        if not names:
            return []
        if AGENT in names and self._mask is not None:
            told.append(f"{show(AGENT)} acts under the {self._mask} mask.")
        lacking = [f"{SHORT[key]} = {_listed(points)}" for key, points in budget["trained_points"].items() if points]
        if lacking:
            told.append(f"To save time this budget trains {_together(names)} only at {'; '.join(lacking)}.")
        if budget["trained_colocation"] == [False]:
            told.append(f"{_together(names)}: trained for each point, for colocation off only.")
        return told

    def _trained(self, name: str, world: Point, reward: Sequence[str] | None = None, seed: int = 0) -> Cell | None:
        """The training behind a method on a scenario; None for a planner."""
        return None if name in self.planners else self.training(name, world, reward, seed)

    def _run(self, kind: str, name: str, world: Point, seeds: Sequence[int], run: Cell | None) -> Cell:
        alone = kind == "timing"
        label = _label(name if kind == "evaluation" else f"{kind}_{name}", world)
        method = self.planners[name] if run is None else {**self.trained[name]["method"], "name": name}
        spec = {
            "scenario": world,
            "seeds": list(seeds),
            "method": method,
            "training": None if run is None else run.spec,
        }
        more = {"clock": "processor"} if alone else {}
        return make_cell(kind, label, {**spec, **more}, [] if run is None else [run], alone=alone)


LABELS = {
    "dqn_ar": "DQN-AR",
    "nfvdeep": "NFVdeep",
    "lookahead": "DQN-AR with look-ahead",
    "plans": "DQN over plans",
}


def show(name: str) -> str:
    """What figures call a method."""
    return LABELS.get(name, name)


def _together(names: Sequence[str]) -> str:
    return " and ".join(map(show, names))


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _label(name: str, world: Point) -> str:
    substrate = world["substrate"]
    where = f"N{substrate['nodes']}" if substrate["path"] is None else str(substrate["path"]).replace("/", "_")
    colocation = "_coloc" if world["colocation"] else ""
    label = f"{name}_{where}_l{world['arrival_rate']:g}_m{world['mean_lifetime']:g}{colocation}"
    return label.replace(".", "p")  # it becomes the name of a config too
