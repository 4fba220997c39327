"""How fast the simulator, the environment, a collector and methods are, and the memory they take; rows for a table."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import Composite
from torchrl.envs import EnvBase

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import scenario_for
from nfv_torchrl.experiments.loaded import batches, load_networks, loaded_env, make_scenario, median_rates, vm_use
from nfv_torchrl.methods import methods_from_config
from nfv_torchrl.methods.lookahead_play import LookaheadPlay
from nfv_torchrl.networks import LookaheadNetwork, Sizes
from nfv_torchrl.observations import CandidateObservation, LookaheadObservation, ObservationPart
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator, kernels
from nfv_torchrl.simulator.state import OUTCOME
from nfv_torchrl.training.random_policy import RandomPolicy

ROLLOUT, COLLECTED = 64, 16
"""Steps of each environment in a rollout, and in a batch of the collector."""
WARM_UP, EXPLORED = 16, 0.05
"""Steps before rows are timed, and the share of random actions among those that they are timed with."""

Row = dict[str, Any]


def run_kernel(config: dict[str, Any]) -> Iterator[Row]:
    for nodes, batch, scenario, steps in batches(config):
        simulator = Simulator(scenario, batch)
        load_networks(simulator, config["loaded_slot"])
        states = np.random.default_rng(0).integers(1, 2**63, batch).astype(np.uint64)
        before, slot = vm_use(simulator), int(simulator.world.env["slot"].min())
        answered: list[int] = []

        def count(simulator=simulator, states=states, steps=steps, answered=answered) -> int:
            answered.append(kernels.random_steps(simulator.world, steps, states))
            return steps * len(states)

        cpu, wall = median_rates(config, count)
        if simulator.world.env["slot"].min() < slot:
            raise ScenarioError("a network was emptied while it was measured; lower frames or repeats")
        requests = sum(answered) / (len(answered) * steps * batch)
        yield {
            "N": nodes,
            "resources": len(scenario.substrate.resources),
            "B": batch,
            "steps/s": cpu,
            "steps/s (wall)": wall,
            "requests/s": cpu * requests,
            "VM use before": before,
            "VM use after": vm_use(simulator),
            "MB per env": simulator.memory_bytes() / batch / 1e6,
        }


def run_env(config: dict[str, Any]) -> Iterator[Row]:
    for nodes, batch, scenario, steps in batches(config, ROLLOUT):
        env, policy = loaded_env(config, batch, scenario), RandomPolicy()
        env.reset()
        state = {"next": env.rollout(1, policy, auto_reset=False, tensordict=env.reset())[:, -1]["next"]}

        def count(env=env, policy=policy, steps=steps, state=state, batch=batch) -> int:
            for _ in range(steps // ROLLOUT):
                rollout = env.rollout(ROLLOUT, policy, auto_reset=False, tensordict=state["next"])
                state["next"] = rollout[:, -1]["next"].exclude("reward")
            return steps // ROLLOUT * ROLLOUT * batch

        cpu, wall = median_rates(config, count)
        yield {
            "N": nodes,
            "B": batch,
            "frames/s": cpu,
            "frames/s (wall)": wall,
            f"rollouts of {ROLLOUT} steps/s": cpu / ROLLOUT / batch,
            "VM use after": vm_use(env.simulator),
        }


def run_collector(config: dict[str, Any]) -> Iterator[Row]:
    """``NFVEnv`` in a collector, and what is the collector's own part: the same with an ``IdleEnv``."""
    for nodes, batch, scenario, steps in batches(config, COLLECTED):
        env = loaded_env(config, batch, scenario)
        (cpu, wall), (idle, _) = (_collect(config, each, steps) for each in (env, IdleEnv(env)))
        yield {
            "N": nodes,
            "B": batch,
            "frames/s": cpu,
            "frames/s (wall)": wall,
            "idle env, frames/s": idle,
            "VM use after": vm_use(env.simulator),
        }


def _collect(config: dict[str, Any], env: EnvBase, steps: int) -> tuple[float, float]:
    # One device for all, as in the recipes: without one, TorchRL casts every key twice in every step. The batch is
    # read before the next one is collected, so it need not be copied.
    collector = Collector(env, RandomPolicy(), frames_per_batch=COLLECTED * env.batch_size[0], total_frames=-1,
                          device="cpu", auto_register_policy_transforms=False, track_traj_ids=False,
                          return_same_td=True)  # fmt: skip
    data = iter(collector)
    rates = median_rates(config, lambda: sum(next(data).numel() for _ in range(steps // COLLECTED)))
    collector.shutdown()
    return rates


class IdleEnv(EnvBase):
    """An environment that does nothing: copies of the first observation and mask of ``env``, no ``outcome``."""

    def __init__(self, env: EnvBase) -> None:
        super().__init__(device=env.device, batch_size=env.batch_size)
        self._shown = env.reset().select("observation", "action_mask", "done", "terminated")
        seen = {key: env.observation_spec[key].clone() for key in ("observation", "action_mask")}
        self.observation_spec = Composite(seen, shape=env.batch_size)
        self.action_spec, self.reward_spec = env.action_spec.clone(), env.reward_spec.clone()
        self.done_spec = env.full_done_spec.clone()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._shown.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._shown.clone().set("reward", self.reward_spec.zero())

    def _set_seed(self, seed: int | None) -> None:
        pass


def run_rows(config: dict[str, Any]) -> Iterator[Row]:
    """What an environment's step costs with the rows of ``candidate`` and of ``lookahead``, for the same actions: those
    of an untrained look-ahead network, and now and then a random one."""
    for _, batch, scenario, steps in batches(config, COLLECTED):
        simulator = Simulator(scenario.replace(mask="feasible", admission_control=True), batch)
        load_networks(simulator, config["loaded_slot"])
        parts: dict[str, ObservationPart] = {
            "candidate": CandidateObservation(),
            "lookahead": LookaheadObservation(),
            "lookahead, bounds": LookaheadObservation(exact=False),
        }
        player = LookaheadPlay(LookaheadNetwork(Sizes.of(simulator)))
        player.prepare(simulator.world)
        seconds = dict.fromkeys(["step", *parts], 0.0)
        rng = np.random.default_rng(0)
        for step in range(steps + WARM_UP):
            if step == WARM_UP:
                seconds = dict.fromkeys(seconds, 0.0)
            for name, part in parts.items():
                begun = time.process_time()
                part.read(simulator)
                seconds[name] += time.process_time() - begun
            actions = player.choose(simulator)[0]
            for b in np.flatnonzero(rng.random(batch) < EXPLORED):
                actions[b] = rng.choice(simulator.world.seen.valid[b, : simulator.world.env["mask_count"][b]])
            begun = time.process_time()
            simulator.step(actions)
            seconds["step"] += time.process_time() - begun
        spent = {name: 1e6 * (seconds["step"] + seconds[name]) / (steps * batch) for name in parts}
        yield {
            "N": simulator.tables.num_nodes[0],
            "B": batch,
            **{f"us a step, {name}": value for name, value in spent.items()},
            "lookahead over candidate": spent["lookahead"] / spent["candidate"],
            "VM use after": vm_use(simulator),
        }


def run_methods(config: dict[str, Any]) -> Iterator[Row]:
    batch = config["methods"]["batch_size"]
    for nodes in config["nodes"]:
        for name, entry in config["method"].items():
            scenario = make_scenario(config, nodes, 1000)
            (method,) = methods_from_config({name: entry}, scenario)
            simulator = Simulator(scenario_for(scenario, method), batch, one_hot=method.one_hot)
            load_networks(simulator, config["loaded_slot"], different=batch)
            method.prepare(simulator, range(batch))
            before = vm_use(simulator)
            decide(simulator, method, config["methods"]["seconds"] / 10)
            requests, cpu, wall = decide(simulator, method, config["methods"]["seconds"])
            yield {
                "method": method.name,
                "N": nodes,
                "requests/s": requests / cpu,
                "requests/s (wall)": requests / wall,
                "us per request": 1e6 * cpu / requests,
                "VM use before": before,
                "VM use after": vm_use(simulator),
            }


def decide(simulator: Simulator, method: Any, seconds: float) -> tuple[int, float, float]:
    """Let ``method`` decide for so long. Returns requests answered, processor and wall seconds it took to decide."""
    requests, cpu, wall = 0, 0.0, 0.0
    while (cpu < seconds or not requests) and not simulator.world.env["done"].all():
        begun = time.process_time(), time.perf_counter()
        actions = method.act(simulator)
        cpu += time.process_time() - begun[0]
        wall += time.perf_counter() - begun[1]
        simulator.step(np.ascontiguousarray(actions, np.int64))
        requests += int(simulator.world.outcome[:, OUTCOME.request_done].sum())
    return max(requests, 1), cpu, wall


def run_memory(config: dict[str, Any]) -> Iterator[Row]:
    for setting in config["memory"]:
        values = {key: value for key, value in setting.items() if key not in ("nodes", "batch_size")}
        substrate = {**config["scenario"]["substrate"], "nodes": setting["nodes"]}
        scenario = Scenario.from_config({**config["scenario"], **values, "substrate": substrate})
        simulator = Simulator(scenario, setting["batch_size"])
        # No request arrives after the last slot, so the pools have their final size.
        load_networks(simulator, scenario.horizon - 1, different=2)
        yield {
            "N": setting["nodes"],
            "B": setting["batch_size"],
            "lambda": scenario.arrival_rate,
            "mu": scenario.mean_lifetime,
            "T": scenario.horizon,
            "running requests": float(simulator.world.env["num_running"].mean()),
            "GB": simulator.memory_bytes() / 1e9,
            "MB per env": simulator.memory_bytes() / setting["batch_size"] / 1e6,
            "largest GB of the process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        }
