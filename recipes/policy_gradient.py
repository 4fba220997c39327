"""Train a stochastic policy by policy gradient (REINFORCE, A2C, PPO), explicitly, top to bottom.

    python recipes/policy_gradient.py                    # PPO, scenario=paper
    python recipes/policy_gradient.py pg_loss=reinforce scenario=heavy scenario.admission_control=true
    python recipes/policy_gradient.py collector=multi_sync collector.workers=4
    python recipes/policy_gradient.py env=nfvdeep        # NFVdeep (Xiao et al. 2019): one function a decision
    python recipes/policy_gradient.py run_dir=runs/policy_gradient resume=true

The policy explores by sampling from its own masked distribution; evaluations take its most probable action.
Copy, paste and change it: every part below can be replaced without touching the others.
"""

from __future__ import annotations

import math
import time
from functools import partial

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import GlobalRNGState

from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import PolicyGradientSettings, read_settings
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.collecting import World
from nfv_torchrl.training.disk import check_room
from nfv_torchrl.training.evaluating import Evaluator
from nfv_torchrl.training.finite import check_learning
from nfv_torchrl.training.learner import gradient_step
from nfv_torchrl.training.logger import METRICS, RunLogger
from nfv_torchrl.training.occasions import Evaluations
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.room import check_environments
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.training.setup import StopRequest, choose_device, make_loss, seed_everything, set_threads
from nfv_torchrl.training.window import TrainingWindow


@recipe("policy_gradient")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, PolicyGradientSettings)
    device = choose_device(cfg.device)
    set_threads(cfg.threads)
    seed_everything(cfg.seed)
    config = OmegaConf.to_container(cfg, resolve=True)
    scenario = Scenario.from_config(config["scenario"])
    check_environments(scenario, cfg.collector.num_envs, cfg.collector.steps)
    folder = RunFolder(config, [scenario])

    # What one decision is; the loss then makes the networks, whose observations the environment has to emit.
    decisions = instantiate(cfg.env)
    sizes = decisions.sizes(scenario, one_hot=cfg.one_hot)
    loss = make_loss(cfg.loss, instantiate(cfg.network), sizes).to(device)
    environment = partial(decisions.environment, loss=loss, reward=instantiate(cfg.reward), one_hot=cfg.one_hot)
    start = {"stagger": cfg.stagger, "segment": cfg.segment, "seed": cfg.seed, "threads": cfg.env_threads}
    collector = instantiate(cfg.collector)
    collector.prepare(World(partial(environment, **start), [scenario], cfg.seed))
    # Made anew for each evaluation: a compiled method keeps the weights that it was made with.
    method = partial(decisions.method, loss, one_hot=cfg.one_hot)
    optimizer = torch.optim.Adam(loss.parameters(), lr=cfg.learner.lr)

    progress = Progress()
    window = TrainingWindow(tuple(kind.name for kind in scenario.catalogue.types), scenario.warmup)
    state = {
        "loss": loss,
        "optimizer": optimizer,
        "env": collector,
        "window": window,
        "progress": progress,
        "rng": GlobalRNGState(),
    }
    # Before the collector, whose first reset starts the horizons of a new environment and goes on in a loaded one.
    folder.load(state)
    batches = collector.start(loss.actor, device)
    iterations = math.ceil(cfg.collector.total_frames / (cfg.collector.num_envs * cfg.collector.steps))
    check_room(folder.path, state, config, iterations=iterations)
    folder.open()  # after all that may be refused: an older run there is set aside
    logger = RunLogger(folder, progress)
    logger.start(OmegaConf.to_yaml(cfg, resolve=True), config, METRICS)
    evaluator = Evaluator(scenario, sizes, config, folder, logger, method)
    evaluations = Evaluations(cfg.eval.interval, iterations)
    bar = ProgressBar(total=cfg.collector.total_frames, initial=progress.frames, unit="frame", pauses=evaluations.count)
    folder.load_random_numbers(state)  # making the parts above drew some

    if not progress.iteration and evaluations.due(0):
        with bar.pause():
            evaluator.evaluate(loss, progress)  # untrained
    with StopRequest() as stop:
        while progress.frames < cfg.collector.total_frames and not stop.asked:
            collector.send_policy()
            data = next(batches, None)
            if data is None:  # a worker failed; all else is saved
                stop.asked = True
                break
            progress.iteration += 1
            progress.frames += data.numel()
            window.add(data)

            # On-policy: what was collected is learned from now and then forgotten.
            started = time.perf_counter()
            rows = loss.prepare(data.to(device))
            for _ in range(cfg.learner.epochs):
                for picked in torch.randperm(len(rows), device=device).split(cfg.learner.minibatch):
                    learning = gradient_step(loss, optimizer, rows[picked], cfg.learner.max_grad_norm)
                    progress.updates += 1
            progress.learning_seconds += time.perf_counter() - started
            check_learning(learning, progress)

            if progress.iteration % cfg.logger.interval == 0:
                bar.say(logger.iteration(progress, window, data, learning))
            if evaluations.due(progress.iteration):
                with bar.pause():
                    evaluator.evaluate(loss, progress)
            if progress.iteration % cfg.saving.interval == 0:
                folder.save(state, progress.frames)
            bar.reach(progress.frames)

        bar.close()
        folder.save(state, progress.frames)
        logger.close()
        folder.print_ending(interrupted=stop.asked)
    collector.shutdown()  # says what failed


if __name__ == "__main__":
    main()
