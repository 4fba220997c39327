"""Time to quality: when a share counts as reached by hand, and the benchmark once for real at tiny size."""

from __future__ import annotations

import csv

import gymnasium
import numpy as np
import pytest
from inprocess import call, recipe
from sb3_contrib import MaskablePPO
from tiny import TINY_SCENARIO

from nfv_torchrl.experiments.gym_training import compiled
from nfv_torchrl.experiments.time_to_quality import Point, curve_of, first_at, quality_rows, quality_table, reached
from nfv_torchrl.gym import ENV_ID
from nfv_torchrl.gym.sb3 import SB3VecEnv
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator

SHARES = [0.95, 0.98]
UP_AND_DOWN = [Point(0, 0.0, 0.80), Point(1000, 2.0, 0.96), Point(2000, 4.0, 0.90), Point(3000, 6.0, 0.99)]
SLOW = [Point(0, 0.0, 0.70), Point(1000, 3.0, 0.85), Point(2000, 8.0, 0.95), Point(3000, 9.0, 0.94)]
NEVER = [Point(0, 0.0, 0.60), Point(1000, 3.0, 0.65)]


def test_the_first_evaluation_with_that_share_counts():
    assert first_at(UP_AND_DOWN, 0.95) == UP_AND_DOWN[1] and first_at(UP_AND_DOWN, 0.98) == UP_AND_DOWN[3]
    assert first_at(UP_AND_DOWN, 0.80) == UP_AND_DOWN[0]
    assert first_at(SLOW, 0.95) == SLOW[2] and first_at(SLOW, 0.98) is None
    assert first_at([Point(10, 1.0, 0.9799999)], 0.98) and not first_at([Point(10, 1.0, 0.97999)], 0.98)


def test_shares_are_of_the_exact_search_and_no_time_is_before_the_first_frame():
    points = [{"frames": 0, "aar": 0.4, "processor_seconds": 0.3}, {"frames": 64, "aar": 0.72, "processor_seconds": 5}]
    assert curve_of({"eval": points}, 0.8) == [Point(0, 0.0, 0.5), Point(64, 5, pytest.approx(0.9))]


def test_medians_take_what_was_not_reached_for_later_than_all():
    rows = quality_rows({"mine": {0: UP_AND_DOWN, 1: SLOW, 2: NEVER}}, SHARES)
    assert [row["seconds_to/0.95"] for row in rows] == [2.0, 8.0, None]
    assert [row["frames_to/0.98"] for row in rows] == [3000, None, None]
    assert reached(rows, 0.95) == "8 s, 2k (2/3)"  # the median of 2, 8, never
    assert reached(rows, 0.98) == "not reached (1/3)"
    assert reached(rows[:1], 0.95) == "2 s, 1k" and reached(rows[2:], 0.95) == "not reached"
    exact = quality_rows({"exact": {0: [Point(0, 0.0, 1.0), Point(1000, 2.0, 0.9)]}}, SHARES)
    assert reached(exact, 0.98) == "0 s, untrained"
    (line,) = quality_table("", rows, SHARES).rows
    # Means: untrained of 0.8, 0.7, 0.6; the best of 0.99, 0.95, 0.65; at the end 0.99, 0.94, 0.65.
    assert line == ("mine", "8 s, 2k (2/3)", "not reached (1/3)", "0.7000", "0.8633", "0.8600", "2k", "6", "3")


def test_the_compiled_policy_of_maskable_ppo_chooses_as_it_does():
    scenario = Scenario.from_config({"substrate": {"nodes": 6}, "horizon": 20, "mask": "feasible"})
    envs = SB3VecEnv(gymnasium.make_vec(ENV_ID, num_envs=4, scenario=scenario))
    model = MaskablePPO("MlpPolicy", envs, n_steps=4, batch_size=16, seed=3, device="cpu").learn(16)
    method, simulator = compiled(model, scenario), Simulator(scenario, 4, one_hot=True)
    for b in range(4):
        simulator.start(b, scenario.workload(b), None)
    method.prepare(simulator, range(4))
    for _ in range(30):
        seen, mask = simulator.world.seen.flat.copy(), simulator.world.seen.mask.copy()
        actions = method.act(simulator)
        np.testing.assert_array_equal(actions, model.predict(seen, deterministic=True, action_masks=mask)[0])
        simulator.step(actions)


TINY = [
    "collector.num_envs=4", "collector.steps=8", "collector.total_frames=96", "buffer.size=500", "buffer.batch_size=32",
    "buffer.warmup_frames=64", "learner.updates=2", "eval.interval=1", "network.hidden=[16]",
]  # fmt: skip


def test_for_real_and_not_twice(tmp_path):
    arguments = [
        "only=[mlp,maskable_ppo]", "seeds=1", "workloads=[7]", "shares=[0.2,2]", f"output={tmp_path}", *TINY_SCENARIO,
        f"overrides=[{','.join(map(repr, TINY))}]", "maskable_ppo.frames=64", "maskable_ppo.evaluations=2",
        "maskable_ppo.num_envs=2", "maskable_ppo.steps=16", "maskable_ppo.batch_size=32",
    ]  # fmt: skip
    call("time_to_quality", *arguments)
    with (tmp_path / "time_to_quality.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert {name: int(row["frames"]) for name, row in rows.items()} == {"mlp": 96, "maskable_ppo": 64}
    for row in rows.values():
        assert row["seconds_to/2"] == "" and float(row["seconds_to/0.2"]) >= 0
        assert 0.2 < float(row["aar_share"]) <= float(row["aar_share_best"]) and float(row["processor_seconds"]) > 0
    with (tmp_path / "curves.csv").open() as file:
        drawn = [(row["series"], int(row["frames"]), float(row["x"])) for row in csv.DictReader(file)]
    assert [frames for name, frames, _ in drawn if name == "mlp"] == [0, 32, 64, 96]
    assert [frames for name, frames, _ in drawn if name == "maskable_ppo"] == [0, 32, 64]
    text = (tmp_path / "time_to_quality.md").read_text()
    assert "| mlp | " in text and "not reached" in text and "training seed" in text
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").iterdir()}
    call("time_to_quality", *arguments, "compute=false")
    assert (tmp_path / "time_to_quality.md").read_text() == text
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").iterdir()}


@pytest.mark.parametrize(
    ("override", "told"),
    [("only=[mpl]", "'mpl'"), ("+methods.x={recipe: evolution, overrides: []}", "recipes: dqn, policy_gradient")],
)
def test_what_is_unknown_is_named(tmp_path, capsys, override, told):
    with pytest.raises(SystemExit):
        call("time_to_quality", override, f"output={tmp_path / 'out'}")
    assert told in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_cells_of_a_benchmark_that_takes_an_hour_stay():
    config = {"settings": {"dqn": ["a"]}, "methods": {"m": {"overrides": ["b"]}}, "overrides": ["c"], "scenario": {}}
    cell = recipe("time_to_quality").training_cell({**config, "workloads": [3, 4]}, "m", 1)
    assert cell.spec["overrides"] == ["a", "b", "c", "seed=1", "eval.seeds=[3,4]"] and cell.alone
