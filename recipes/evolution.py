"""Evolve a policy on whole horizons, explicitly, top to bottom.

    python recipes/evolution.py                                   # learned prices, trained on random networks
    python recipes/evolution.py policy=candidate tasks=fixed_network scenario.colocation=true
    python recipes/evolution.py run_dir=runs/evolution resume=true

Every generation draws horizons, lets every candidate play the same ones in the compiled simulator, and tells CMA-ES
how much each won over the exact search of every request by itself (``myopic_optimal``). What a refusal is worth shows
thousands of requests later, and here all of them count. A frame is one request answered. The policy is the centre of
the search; ``best.pt`` is the one that was fittest on held-out horizons.
"""

from __future__ import annotations

import time
from statistics import fmean

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import GlobalRNGState

from nfv_torchrl.evolution import Strategy
from nfv_torchrl.evolution.board import EvolutionBoard
from nfv_torchrl.evolution.fitness import Arena, summary
from nfv_torchrl.methods import load_weights, policy_content
from nfv_torchrl.networks import Sizes
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import EvolutionSettings, read_settings
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.disk import check_room
from nfv_torchrl.training.finite import check_fitness
from nfv_torchrl.training.layout import EVOLVED
from nfv_torchrl.training.logger import RunLogger
from nfv_torchrl.training.occasions import Evaluations
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.training.setup import StopRequest, seed_everything, set_threads

FITNESS = ("eval/fitness", "eval/aar", "eval/paired_cost")
"""What the HParams tab shows of a run."""


@recipe("evolution")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, EvolutionSettings)
    set_threads(1)  # more work at once is for the arena
    seed_everything(cfg.seed)
    config = OmegaConf.to_container(cfg, resolve=True)
    scenario = Scenario.from_config(config["scenario"])
    folder = RunFolder(config, [scenario])

    # What evolves, from where, and what it is measured by.
    sizes = Sizes.of(Simulator(scenario, 1))
    policy = instantiate(cfg.policy, network=instantiate(cfg.network), sizes=sizes)
    if cfg.init_from is not None:
        load_weights(policy.network, cfg.init_from)
    # The scenario goes in whole: Hydra would build what it names, such as a generator of networks.
    tasks = instantiate({**config["tasks"], "_partial_": True})(config["scenario"])
    held_out = tasks.draw(cfg.eval.seed, 0, cfg.eval.tasks)
    arena = Arena(instantiate(cfg.parallel), **cfg.fitness)
    strategy = Strategy(policy.vector(), **cfg.strategy, seed=cfg.seed)

    progress = Progress()
    state = {"strategy": strategy, "progress": progress, "rng": GlobalRNGState()}
    folder.load(state)
    check_room(folder.path, state, config, iterations=cfg.generations)
    folder.open()  # after all that may be refused: an older run there is set aside
    logger = RunLogger(folder, progress)
    logger.start(OmegaConf.to_yaml(cfg, resolve=True), config, FITNESS, EVOLVED)
    evaluations = Evaluations(cfg.eval.interval, cfg.generations)
    bar = ProgressBar(total=cfg.generations, initial=strategy.generation, unit="generation", pauses=evaluations.count)

    def evaluate() -> None:
        """The centre of the search on held-out horizons; keep it if it is the fittest so far."""
        centre = policy.with_vector(strategy.mean)
        (scores,) = arena.scores([centre], held_out, known)
        values = summary(scores)
        board.show(centre, values, progress.frames)
        if progress.frames and values["fitness"] > progress.best_fitness:
            progress.best_fitness, progress.best_aar = values["fitness"], values["aar"]
            progress.best_frames = progress.frames
            folder.save_best(policy_content(centre, sizes, config, centre.settings(scenario), values))

    with arena.workers, StopRequest() as stop:
        known = arena.baselines(held_out) if cfg.eval.interval else []
        if cfg.eval.interval:
            with bar.pause():
                board = EvolutionBoard(logger, config, held_out, known, arena.workers)
        if not strategy.generation and evaluations.due(0):
            with bar.pause():
                evaluate()  # where the search begins
        while strategy.generation < cfg.generations and not stop.asked:
            started = time.perf_counter()
            horizons = tasks.draw(cfg.seed, strategy.generation, cfg.generation.tasks)
            candidates = [policy.with_vector(vector) for vector in strategy.ask()]
            scores = arena.scores(candidates, horizons)
            fitness = [fmean(score.fitness for score in row) for row in scores]
            check_fitness(fitness, strategy.generation)
            strategy.tell(fitness)

            played = len(candidates) * sum(len(task.workload) for task in horizons)
            progress.frames += played
            progress.iteration += 1
            metrics = {f"train/{name}": value for name, value in summary([s for row in scores for s in row]).items()}
            metrics |= {"train/fitness_best": max(fitness), "train/sigma": strategy.sigma}
            metrics["speed/requests_per_second"] = played / (time.perf_counter() - started)
            logger.scalars(metrics, progress.frames)
            bar.say(f"fitness {metrics['train/fitness']:+.3f}, best {max(fitness):+.3f}")
            bar.update()
            if evaluations.due(strategy.generation):
                with bar.pause():
                    evaluate()
            if strategy.generation % cfg.saving.interval == 0:
                folder.save(state, progress.frames)

        bar.close()
        folder.save(state, progress.frames)
        logger.close()
        print(f"Processor time: {time.process_time():.0f} s")
        folder.print_ending(interrupted=stop.asked)


if __name__ == "__main__":
    main()
