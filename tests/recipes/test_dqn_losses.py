"""Every loss and network trains through the DQN recipe with nothing but its name, and resumes exactly."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from inprocess import call
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING, with_preset

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN
from nfv_torchrl.methods import load_policy
from nfv_torchrl.networks import MLPNetwork, Sizes
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.evaluating import Evaluator
from nfv_torchrl.training.logger import RunLogger
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.vocabulary import without_row

CHOICES = {
    "dqn": ["loss=dqn"],
    "double_dqn": ["loss=double_dqn"],
    "n_step": ["loss=n_step"],
    "distributional": ["loss=distributional"],
    "discrete_sac": ["loss=discrete_sac", "exploration=none"],
    "cql": ["loss=cql"],
    "iqn": ["loss=iqn", "network=implicit", "network.hidden=[8,8]", "loss.quantiles=2"],
    "munchausen": ["loss=munchausen"],
    "rainbow": ["preset=rainbow", "network.hidden=[8,8]"],
    "paper_literal": ["preset=paper", "loss=paper_literal"],
    "DQNLoss": ["loss._target_=torchrl.objectives.DQNLoss", "+loss.delay_value=false", "buffer=prioritized"],
    "DistributionalDQNLoss": ["loss._target_=torchrl.objectives.DistributionalDQNLoss", "+loss.atoms=5"],
    "DiscreteSACLoss": ["loss._target_=torchrl.objectives.DiscreteSACLoss", "exploration=none", "network=noisy"],
    "DiscreteIQLLoss": ["loss._target_=torchrl.objectives.DiscreteIQLLoss", "network=candidate"],
    "dueling": ["network=dueling"],
    "noisy": ["network=noisy", "exploration=none"],
    "candidate": ["network=candidate", "loss=distributional"],
    "plans": [
        "preset=plans",
        "networks.nodes=[5,7]",
        "networks.arrival_rate=[4]",
        "segment=5",
        *TINY_TRAINING,
    ],
    "lookahead": [
        "preset=lookahead",
        "networks.nodes=[5,7]",
        "networks.arrival_rate=[4]",
        "eval.networks.nodes=[5,7]",
        "eval.networks.arrival_rate=[4]",
        "eval.networks.horizon=[40]",
        "eval.count=2",
        "segment=5",
        *TINY_TRAINING,
    ],
    "plans by quantiles": ["env=plans", "network=mlp", "loss=distributional"],
    "networks": ["network=candidate", "networks=random", "networks.nodes=[5,7]", "networks.arrival_rate=[4]"],
}


def train(folder, *overrides):
    call(
        "dqn",
        f"run_dir={folder}",
        *TINY_SCENARIO,
        "scenario.horizon=20",
        *TINY_TRAINING,
        "eval.interval=6",
        "saving.interval=3",
        *with_preset(overrides),
    )


@pytest.mark.parametrize("name", CHOICES)
def test_it_trains_resumes_to_the_bit_and_loads(name, tmp_path):
    folder = tmp_path / "run"
    train(folder, *CHOICES[name], "collector.total_frames=192")
    whole = load_file(CheckpointFolder(folder).files()[-1])
    CheckpointFolder(folder).files()[-1].unlink()
    train(folder, *CHOICES[name], "collector.total_frames=192", "resume=true")
    again = load_file(CheckpointFolder(folder).files()[-1])
    assert again["progress"]["frames"] == 192
    events = EventAccumulator(str(folder))
    events.Reload()
    assert not without_row(events.Tags()["scalars"])
    for key, value in whole["loss"].items():
        assert torch.equal(value, again["loss"][key]), key
        assert torch.isfinite(value).all()

    scenario = Scenario.from_config(whole["config"]["scenario"])
    method = load_policy(folder / "best.pt", scenario)
    once, twice = (run_method(scenario, method, [1000])[0] for _ in range(2))
    assert (once.accepted == twice.accepted).all() and (once.step_node == twice.step_node).all()  # no noise left


def test_plans_of_chains_train_on_draws_resume_to_the_bit_and_load(tmp_path):
    """Virne's chains, with free ends, on networks of several draws."""
    laws = (ROOT / "docs/benchmark/chains_0.28.yaml").read_text().replace("num_v_nets: 1000", "num_v_nets: 30")
    path, folder = tmp_path / "laws.yaml", tmp_path / "run"
    path.write_text(laws.replace("high: 10}", "high: 4}"))
    overrides = [
        f"run_dir={folder}", *TINY_TRAINING, "preset=plans", "scenario=virne", f"scenario.workload.path={path}",
        "scenario.substrate.generator={_target_: nfv_torchrl.scenario.waxman.draw_waxman, nodes: 8, beta: 1}",
        "networks=redrawn", "networks.draws=3", "networks.substrates=2", f"networks.workloads=[{path}]",
        "held_out=redrawn", "eval.count=2", "env.planner.levels=[0,4]", "env.planner.labels=1000", "segment=null",
        "collector.total_frames=192", "saving.interval=3", "eval.interval=6",
    ]  # fmt: skip
    call("dqn", *overrides)
    whole = load_file(CheckpointFolder(folder).files()[-1])
    CheckpointFolder(folder).files()[-1].unlink()
    call("dqn", *overrides, "resume=true")
    again = load_file(CheckpointFolder(folder).files()[-1])
    assert again["progress"]["frames"] == 192
    assert all(torch.equal(value, again["loss"][key]) for key, value in whole["loss"].items())
    scenario = Scenario.from_config({**whole["config"]["scenario"], "seed": 7})
    method = load_policy(folder / "best.pt", scenario)
    (record,) = run_method(scenario, method, [0])
    assert record.accepted.any() and method.planner.menus.labels == 1000


def test_noise_is_off_in_an_evaluation_and_back_after_it(tmp_path):
    scenario = paper_scenario(nodes=4, seed=1, horizon=10, arrival_rate=2)
    sizes = Sizes.of(Simulator(scenario, 1, one_hot=True))
    loss = DQN(partial(MLPNetwork, hidden=[8], noisy=True), sizes)
    folder = SimpleNamespace(path=tmp_path, resume=False, carry=lambda *part: None, save_best=lambda content: None)
    logger, logged = RunLogger(folder, Progress()), []
    config = {
        "one_hot": True,
        "seed": 0,
        "eval": {"seeds": [5]},
        "logger": {"figures": False, "references": False},
        "network": {"_target_": "nfv_torchrl.networks.MLPNetwork"},
        "loss": {"_target_": "nfv_torchrl.losses.DQN"},
    }
    logger.scalars = lambda values, frames: logged.append(values)
    torch.manual_seed(0)
    drawn = torch.get_rng_state()
    evaluator = Evaluator(scenario, sizes, config, folder, logger)
    for _ in range(2):
        evaluator.evaluate(loss, Progress())
    logger.close()
    assert torch.equal(torch.get_rng_state(), drawn)
    assert loss.actor.training and all(module.training for module in loss.actor.modules())
    first, again = (values for values in logged if "eval/aar" in values)
    assert all(first[tag] == again[tag] for tag in first if not tag.startswith("speed/"))
    seen = torch.zeros(1, sizes.observation)
    layers = loss.actor[0].module.layers
    assert not torch.equal(layers(seen), layers(seen))


def test_random_networks_need_a_network_of_any_size(tmp_path, capsys):
    with pytest.raises(SystemExit):
        train(tmp_path / "run", "networks=random", "networks.nodes=[5,7]", "networks.arrival_rate=[4]")
    assert "set network=lookahead" in capsys.readouterr().err
