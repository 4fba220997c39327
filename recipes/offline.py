"""Learn from recorded decisions of any method, explicitly, top to bottom: record, train, evaluate.

    python recipes/offline.py                                     # conservative Q-learning from greedy's decisions
    python recipes/offline.py method=[myopic_optimal] loss=imitation
    python recipes/offline.py dataset=runs/greedy_data run_dir=runs/cql loss.alpha=0.5
    python recipes/offline.py run_dir=runs/offline resume=true

A run first lets the method act in the environment and writes every step to a dataset, unless there is one already. It
then learns from nothing but the dataset. Evaluations act on workloads that are not in it, under the rules of the
recording: where a planner refuses requests by itself, the policy may, too.
"""

from __future__ import annotations

import time

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.checkpoint import GlobalRNGState

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import scenario_for
from nfv_torchrl.losses import has_target, q_network
from nfv_torchrl.methods import methods_from_config
from nfv_torchrl.networks import Sizes
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import OfflineSettings, read_settings
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.disk import check_room
from nfv_torchrl.training.evaluating import Evaluator
from nfv_torchrl.training.finite import check_learning
from nfv_torchrl.training.learner import gradient_step
from nfv_torchrl.training.logger import METRICS, RunLogger
from nfv_torchrl.training.occasions import Evaluations
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.recording import Dataset
from nfv_torchrl.training.replay import check_replay, make_buffer, some_rows
from nfv_torchrl.training.room import check_compiler, check_environments
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.training.sampler_state import SamplerState
from nfv_torchrl.training.setup import StopRequest, choose_device, make_loss, seed_everything, set_threads
from nfv_torchrl.training.window import TrainingWindow

ORIGIN = ("scenario", "method", "checkpoint", "reward", "one_hot", "stagger", "record")
"""Config keys that determine a recording."""


@recipe("offline")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, OfflineSettings)
    device = choose_device(cfg.device)
    set_threads(cfg.threads)
    seed_everything(cfg.seed)
    config = OmegaConf.to_container(cfg, resolve=True)
    scenario = Scenario.from_config(config["scenario"])
    check_environments(scenario, cfg.record.num_envs, cfg.record.steps, "record")
    if cfg.learner.compile:
        check_compiler(device)
    methods = methods_from_config(config["method"], scenario)
    if len(methods) != 1:
        raise ScenarioError(f"method: {len(methods)} were given; one is recorded, such as method=[greedy]")
    method = methods[0]
    scenario = scenario_for(scenario, method)

    # Loss first: it makes the network, whose observations are to be recorded.
    sizes = Sizes.of(Simulator(scenario, 1, one_hot=cfg.one_hot))
    loss = make_loss(cfg.loss, instantiate(cfg.network), sizes).to(device)

    of_one = NFVEnv(scenario, 1, one_hot=cfg.one_hot, observations=q_network(loss).observations())
    rows = some_rows(loss, of_one, steps=cfg.record.steps)
    size = -(-cfg.record.frames // (cfg.record.num_envs * cfg.record.steps)) * cfg.record.num_envs * len(rows)
    check_replay(loss, rows, config["buffer"], size=size)

    # A dataset that does not fit is refused, as all else, before the run's folder is taken.
    folder = RunFolder(config, [scenario])
    env = NFVEnv(
        scenario,
        cfg.record.num_envs,
        reward=instantiate(cfg.reward),
        one_hot=cfg.one_hot,
        observations=q_network(loss).observations(),
        stagger=cfg.stagger,
        seed=cfg.record.seed,
    )
    recording = {"origin": {key: config[key] for key in ORIGIN}, "env": env}
    recording |= {"frames": cfg.record.frames, "steps": cfg.record.steps}
    given = Dataset(cfg.dataset, **recording, apart_from=folder.path) if cfg.dataset else None
    if given and given.complete:
        given.check()
    updater = instantiate(cfg.target)(loss) if has_target(loss) else None
    optimizer = torch.optim.Adam(loss.parameters(), lr=cfg.learner.lr)

    buffer = make_buffer(config["buffer"], size=size, batch_size=cfg.learner.batch_size, device=device)
    beta = instantiate(cfg.buffer.beta)

    def update(batch: TensorDictBase) -> TensorDictBase:
        """One gradient step and one of the target network; what ``torch.compile`` gets."""
        learned = gradient_step(loss, optimizer, batch, cfg.learner.max_grad_norm)
        if updater is not None:
            updater.step()
        return learned

    if cfg.learner.compile:
        update = torch.compile(update)

    progress = Progress()  # its frames are transitions learned from, TensorBoard's horizontal axis
    sampler = SamplerState(buffer)
    state = {"loss": loss, "optimizer": optimizer, "sampler": sampler, "progress": progress, "rng": GlobalRNGState()}
    if updater is not None:
        state["updater"] = updater
    folder.load(state)
    check_room(folder.path, state, config, iterations=cfg.learner.updates)
    folder.open()  # an older run there is set aside
    dataset = given or Dataset(folder.path / "dataset", **recording)
    if not dataset.complete:
        with ProgressBar(total=cfg.record.frames, desc=f"record {method.name}", unit="frame") as bar:
            dataset.record(method, bar.update)

    # Everything that was recorded, in memory, as the loss wants it.
    recorded = TrainingWindow(tuple(kind.name for kind in scenario.catalogue.types), scenario.warmup)
    transitions = []
    for part in dataset.parts():
        recorded.add(part)
        transitions.append(loss.prepare(part).clone())
    buffer.extend(torch.cat(transitions))
    sampler.restore()
    del transitions
    print(
        f"{len(buffer):,} transitions of {method.name} in {dataset.folder}, AAR {recorded.metrics()['train/aar']:.3f}"
    )

    logger = RunLogger(folder, progress)
    logger.start(OmegaConf.to_yaml(cfg, resolve=True), config, METRICS)
    evaluator = Evaluator(scenario, sizes, config, folder, logger)
    evaluations = Evaluations(cfg.eval.interval, cfg.learner.updates)
    bar = ProgressBar(total=cfg.learner.updates, initial=progress.updates, unit="update", pauses=evaluations.count)
    folder.load_random_numbers(state)  # making the parts above drew some

    if not progress.updates and evaluations.due(0):
        with bar.pause():
            evaluator.evaluate(loss, progress)  # untrained
    with StopRequest() as stop:
        while progress.updates < cfg.learner.updates and not stop.asked:
            started = time.perf_counter()
            if beta is not None:
                buffer.sampler.beta = beta(progress.frames)
            learning = update(batch := buffer.sample().to(device, non_blocking=True))
            buffer.update_tensordict_priority(batch)  # if its sampler has any
            progress.updates += 1
            progress.frames += cfg.learner.batch_size
            progress.learning_seconds += time.perf_counter() - started

            if progress.updates % cfg.logger.interval == 0:
                check_learning(learning, progress)
                metrics = {f"train/{key}": float(value) for key, value in learning.items()} | progress.speeds()
                logger.scalars(metrics, progress.frames)
                bar.say(f"loss {metrics['train/loss']:.4f}  best AAR {max(progress.best_aar, 0):.3f}")
            if evaluations.due(progress.updates):
                with bar.pause():
                    evaluator.evaluate(loss, progress)
            if progress.updates % cfg.saving.interval == 0:
                folder.save(state, progress.frames)
            bar.update()

        bar.close()
        folder.save(state, progress.frames)
        logger.close()
        folder.print_ending(interrupted=stop.asked)


if __name__ == "__main__":
    main()
