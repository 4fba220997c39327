"""Train a DQN to admit, place and route service chains (DQN-AR), explicitly, top to bottom.

    python recipes/dqn.py                        # scenario=paper preset=default
    python recipes/dqn.py preset=mlp scenario=geant loss=dqn network.hidden=[512,512]
    python recipes/dqn.py run_dir=runs/dqn resume=true
    python recipes/dqn.py preset=mlp network=candidate init_from=runs/imitation/best.pt
    python recipes/dqn.py preset=plans           # one decision a request, among exact walks, on random networks

Copy, paste and change it: every part below can be replaced without touching the others.
"""

from __future__ import annotations

import math
import time
from functools import partial

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule

from nfv_torchrl.losses import q_network
from nfv_torchrl.methods import load_weights
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import DqnSettings, read_settings
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.collecting import World
from nfv_torchrl.training.disk import check_room
from nfv_torchrl.training.evaluating import Evaluator
from nfv_torchrl.training.finite import check_learning
from nfv_torchrl.training.learner import falling_rate, gradient_step, target_updater
from nfv_torchrl.training.logger import METRICS, RunLogger
from nfv_torchrl.training.memory import MemoryState
from nfv_torchrl.training.occasions import Evaluations
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.replay import check_replay, make_buffer, some_rows
from nfv_torchrl.training.room import check_any_size, check_compiler, check_environments
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.training.setup import StopRequest, choose_device, make_loss, seed_everything, set_threads
from nfv_torchrl.training.window import TrainingWindow


@recipe("dqn")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, DqnSettings)
    device = choose_device(cfg.device)
    set_threads(cfg.threads)
    seed_everything(cfg.seed)
    config = OmegaConf.to_container(cfg, resolve=True)
    scenario = Scenario.from_config(config["scenario"])
    check_environments(scenario, cfg.collector.num_envs, cfg.collector.steps)
    # Where environments live: on the scenario's network, or each on one of its own.
    worlds = [scenario]
    if cfg.networks is not None:
        source = instantiate(config["networks"])(config["scenario"])
        worlds = source.scenarios(cfg.seed, cfg.collector.num_envs)
    folder = RunFolder(config, worlds)

    # What one decision is. Loss first: it makes the network, whose observations the environment has to emit.
    decisions = instantiate(cfg.env)
    sizes = decisions.sizes(worlds, one_hot=cfg.one_hot)
    loss = make_loss(cfg.loss, instantiate(cfg.network), sizes).to(device)
    check_any_size(loss, cfg.networks or cfg.eval.networks)
    if cfg.init_from and not cfg.resume:
        load_weights(q_network(loss), cfg.init_from)
    environment = partial(decisions.environment, loss=loss, reward=instantiate(cfg.reward), one_hot=cfg.one_hot)
    rows = some_rows(loss, environment(worlds[0], 1), steps=cfg.collector.steps)
    item = check_replay(loss, rows, config["buffer"], size=cfg.buffer.size)  # bytes
    start = {"stagger": cfg.stagger, "segment": cfg.segment, "seed": cfg.seed, "threads": cfg.env_threads}
    collector = instantiate(cfg.collector)
    collector.prepare(World(partial(environment, **start), worlds, cfg.seed))
    # Made anew for each evaluation: a compiled method keeps the weights that it was made with.
    method = partial(decisions.method, loss, one_hot=cfg.one_hot)

    # Policy and exploration. A spec of its own: a batched environment's spec would take on the mask.
    explore = EGreedyModule(Categorical(sizes.actions), action_mask_key="action_mask").to(device)
    policy = TensorDictSequential(loss.actor, explore)
    epsilon, beta = instantiate(cfg.exploration), instantiate(cfg.buffer.beta)  # by frames
    frames_per_batch = cfg.collector.num_envs * cfg.collector.steps
    buffer = make_buffer(config["buffer"], size=cfg.buffer.size, batch_size=cfg.buffer.batch_size, device=device)
    updater = target_updater(cfg.target, loss)
    optimizer = torch.optim.Adam(loss.parameters(), lr=cfg.learner.lr, fused=True)

    def update(batch: TensorDictBase) -> TensorDictBase:
        """One gradient step and one of the target network; what ``torch.compile`` gets."""
        learned = gradient_step(loss, optimizer, batch, cfg.learner.max_grad_norm)
        updater.step()
        return learned

    if cfg.learner.compile:
        check_compiler(device)
        update = torch.compile(update)

    progress = Progress()
    window = TrainingWindow(tuple(kind.name for kind in scenario.catalogue.types), scenario.warmup)
    state = {
        "loss": loss,
        "optimizer": optimizer,
        "updater": updater,
        "buffer": MemoryState(buffer, rows),
        "env": collector,
        "window": window,
        "progress": progress,
        "rng": GlobalRNGState(),
    }
    # Before the collector, whose first reset starts the horizons of a new environment and goes on in a loaded one.
    folder.load(state)
    batches = collector.start(policy, device)
    iterations = math.ceil(cfg.collector.total_frames / frames_per_batch)
    check_room(folder.path, state, config, iterations=iterations, memory=cfg.buffer.size * item)
    folder.open()  # after all that may be refused: an older run there is set aside
    logger = RunLogger(folder, progress)
    logger.start(OmegaConf.to_yaml(cfg, resolve=True), config, METRICS)
    evaluator = Evaluator(scenario, sizes, config, folder, logger, method)
    evaluations = Evaluations(cfg.eval.interval, iterations)
    bar = ProgressBar(total=cfg.collector.total_frames, initial=progress.frames, unit="frame", pauses=evaluations.count)
    folder.load_random_numbers(state)  # making the parts above drew some
    learning = TensorDict()  # what the last update said

    if not progress.iteration and evaluations.due(0):
        with bar.pause():
            evaluator.evaluate(loss, progress)  # untrained
    with StopRequest() as stop:
        while progress.frames < cfg.collector.total_frames and not stop.asked:
            explore.eps.fill_(epsilon(progress.frames))
            if beta is not None:
                buffer.sampler.beta = beta(progress.frames)
            collector.send_policy()
            data = next(batches, None)
            if data is None:  # a worker failed; all else is saved
                stop.asked = True
                break
            progress.iteration += 1
            progress.frames += data.numel()
            window.add(data)
            buffer.extend(loss.prepare(data))

            started = time.perf_counter()
            if progress.frames >= cfg.buffer.warmup_frames:
                with falling_rate(optimizer, cfg.learner, progress.frames / cfg.collector.total_frames):
                    for _ in range(cfg.learner.updates):
                        learning = update(batch := buffer.sample().to(device, non_blocking=True))
                        buffer.update_tensordict_priority(batch)  # if its sampler has any
                progress.updates += cfg.learner.updates
            progress.learning_seconds += time.perf_counter() - started
            check_learning(learning, progress)

            if progress.iteration % cfg.logger.interval == 0:
                line = logger.iteration(progress, window, data, learning, epsilon=float(explore.eps))
                bar.say(line)
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
