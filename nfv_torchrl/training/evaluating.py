"""An evaluation in a training: the policy as it is now, on held-out workloads, beside what it is to beat."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from nfv_torchrl.evaluation.network_figure import draw_utilisation
from nfv_torchrl.evaluation.records import FORWARD, REJECT, RunRecord
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.walk_figure import draw_walks, title_of, walk_of
from nfv_torchrl.losses import q_network
from nfv_torchrl.methods import Method, fastest_method, policy_content
from nfv_torchrl.networks import Sizes
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.values import list_of_seeds
from nfv_torchrl.simulator.reasons import REASON_NAMES
from nfv_torchrl.training.finite import check_weights
from nfv_torchrl.training.held_out import HeldOut
from nfv_torchrl.training.logger import RunLogger
from nfv_torchrl.training.page import standing, what_you_see
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.references import EXACT, References, mean_metrics, reference_methods
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.vocabulary import TABLE

COMPARED = ("aar", "cost_per_accepted")
"""Metrics of the references that are logged."""
STEPS = ("place", "forward", "stay", "reject")
"""What a step of a walk can be: a hop with a placement, a hop alone, a placement where the walk is, a refusal."""


@dataclass(frozen=True)
class Evaluator:
    """The evaluations of a training: what they run on, and where what comes of them goes.

    Best means the highest AAR; among equals the lowest cost per accepted request. With ``eval.networks`` it means the
    highest score on those networks (``HeldOut``). The untrained policy (frame 0) is never kept.

    Args:
        scenario: whose workloads ``eval.seeds`` are.
        sizes: sizes that the policy was made for.
        config: the recipe's config.
        folder: of the run.
        logger: of the run.
        method: makes what acts by the loss's actor as it is now; None: ``fastest_method``.
    """

    scenario: Scenario
    sizes: Sizes
    config: Mapping[str, Any]
    folder: RunFolder
    logger: RunLogger
    method: Callable[[], Method] | None = None

    def evaluate(self, loss: Any, progress: Progress) -> None:
        """Act greedily on held-out workloads, log what came of it, and keep the policy if it is the best so far.

        Untrained weights are not kept; those that a run begins with, from ``init_from``, are.
        No random number of the training is drawn, so that how often a run is evaluated changes nothing of what it
        learns.

        Raises:
            TrainingError: weights are not finite; ``best.pt`` stays.
        """
        logger, config, frames = self.logger, self.config, progress.frames
        logger.clock.stop()
        check_weights(loss, "loss", progress)
        seeds = list_of_seeds("eval.seeds", config["eval"]["seeds"])
        references = self._references(seeds) if config["logger"]["references"] else None
        begun = time.perf_counter()
        acting, records = self._act(loss, seeds)
        scores = mean_metrics(records)
        values = _tags(scores, records, acting)
        if references is not None:
            values |= _compare(references, records, logger, frames)
        values |= (held_out := self._held_out(acting))
        values["speed/evaluation_seconds"] = time.perf_counter() - begun
        values["speed/processor_seconds"] = logger.clock.seconds
        logger.scalars(values, frames)
        logger.scalars(_stacked(scores, logger), frames)
        _histograms(loss, acting, records, logger, frames)
        if not logger.resumed and not frames:
            logger.text("1 what you see", what_you_see(self.scenario, config, references), frames)
        logger.text("2 how it stands", standing(scores, values, references, frames), frames)
        if config["logger"]["figures"]:
            draw_pictures(records[0], references, logger, frames)
        # Weights from a file may be better than all that follows; untrained ones are nothing to keep.
        if frames or config.get("init_from"):
            self._keep_best(loss, progress, scores, held_out)
        logger.clock.start()

    def _held_out(self, acting: Method) -> dict[str, float]:
        """Scores on the networks of ``eval.networks``, by tag; what they are compared with is computed once."""
        if not self.logger.held_out:
            self.logger.held_out = [HeldOut.of(self.config)]
        found = self.logger.held_out[0]
        return {} if found is None else {f"eval/{name}": value for name, value in found.scores(acting).items()}

    def _references(self, seeds: Sequence[int]) -> References:
        """Those of the run, computed once; a line shows how far that is."""
        if self.logger.references is None:
            expected = sum(len(self.scenario.workload(seed)) for seed in seeds) * len(reference_methods())
            with ProgressBar(total=expected, desc="references", unit="request") as bar:
                self.logger.references = References.of(self.folder.path, self.scenario, seeds, bar.update)
        return self.logger.references

    def _act(self, loss: Any, seeds: Sequence[int]) -> tuple[Method, list[RunRecord]]:
        """What the policy does on every workload, and the method by which it did; loss and device stay as they were."""
        actor = loss.actor
        device = next(actor.parameters()).device
        actor.eval()  # noisy networks act by their mean weights
        actor.to("cpu")
        acting = (
            self.method() if self.method else fastest_method(actor, q_network(loss), one_hot=self.config["one_hot"])
        )
        with torch.random.fork_rng(devices=[]):  # a network may draw to act; the training goes on as if it had not
            records = run_method(self.scenario, acting, seeds)
        actor.to(device)
        actor.train()
        return acting, records

    def _keep_best(
        self, loss: Any, progress: Progress, scores: Mapping[str, float], held_out: Mapping[str, float]
    ) -> None:
        aar, cost = scores["aar"], scores["cost_per_accepted"]
        if held_out:
            aar, cost = held_out["eval/held_out_score"], held_out["eval/held_out_paired_cost"]
        if (aar, -cost) > (progress.best_aar, -progress.best_cost):
            progress.best_aar, progress.best_cost, progress.best_frames = aar, cost, progress.frames
            known = {name: scores[name] for name in ("aar", "cost_per_accepted")}
            known |= {tag.removeprefix("eval/"): value for tag, value in held_out.items()}
            self.folder.save_best(policy_content(loss, self.sizes, self.config, self.scenario, known))


def _tags(scores: Mapping[str, float], records: Sequence[RunRecord], acting: Method) -> dict[str, float]:
    """What the policy reached, by tag; what does not exist is left out, and times that say nothing of the agent."""
    values = {f"eval/{key}": value for key, value in scores.items() if key not in TABLE or not TABLE[key].measured}
    kinds = np.concatenate([step_kinds(record) for record in records])
    counts = np.bincount(kinds, minlength=len(STEPS)) / max(len(kinds), 1)
    values |= {f"eval/steps/{name}": float(share) for name, share in zip(STEPS, counts, strict=True)}
    chosen = _watched(acting)[:, 0]
    if np.isfinite(chosen).any():
        values["eval/chosen_value"] = float(chosen[np.isfinite(chosen)].mean())
    return _known(values)


def _compare(references: References, records: Sequence[RunRecord], logger: RunLogger, frames: int) -> dict[str, float]:
    """Log the lines that the agent's are read against. Returns its paired costs, by tag."""
    paired = references.paired_costs(records)
    for name, metrics in references.metrics.items():
        line = {key: metrics[key] for key in COMPARED}
        if logger.apart and name in paired:  # in the colour of what it is over
            line["paired_cost"] = paired[name]
        logger.compared(name, _known(line), frames)
    logger.compared("bound", _known({"aar": references.bound}), frames)
    return _known({f"eval/paired_cost/{name}": ratio for name, ratio in paired.items()})


def _known(values: Mapping[str, float]) -> dict[str, float]:
    return {tag: value for tag, value in values.items() if not math.isnan(value)}


def _stacked(scores: Mapping[str, float], logger: RunLogger) -> dict[str, float]:
    """Rejections by reason on top of each other, by tag; reasons that never came up so far are left out."""
    values, total = {}, 0.0
    never = {tag for tag, value in logger.series.constants().items() if value == 0}
    for name in REASON_NAMES:
        share = scores[f"rejected/{name}"]
        total += share
        if share or f"eval/rejected/{name}" not in never:
            values[f"eval/rejected_stacked/{name}"] = total
    return values


def step_kinds(record: RunRecord) -> np.ndarray:
    """What every step of every walk is, int64 [steps], places in ``STEPS``; what is no action counts as a refusal."""
    before = np.r_[-1, record.step_node[:-1]]
    some = np.diff(record.step_offsets) > 0
    first, ingress = record.step_offsets[:-1][some], record.workload.ingress[some]
    before[first] = np.where(ingress < 0, record.step_node[first], ingress)  # a free ingress: no hop leads there
    kinds = np.where(record.step_function == FORWARD, 1, np.where(record.step_node == before, 2, 0))
    kinds[record.step_node <= REJECT] = 3
    return kinds.astype(np.int64)


def _watched(acting: Method) -> np.ndarray:
    """Outputs of some of the actions taken, and the highest of another valid one, float32 [n, 2]; of some methods
    there are none."""
    watch = getattr(acting, "watch", None)
    return np.zeros((0, 2), np.float32) if watch is None else watch.pairs


def _histograms(loss: nn.Module, acting: Method, records: Sequence[RunRecord], logger: RunLogger, frames: int) -> None:
    """How values, steps, hops, weights and gradients spread."""
    pairs = _watched(acting)
    logger.histogram("values/1 of the action taken", pairs[:, 0], frames)
    logger.histogram("values/2 of the best other action", pairs[:, 1], frames)
    logger.histogram("values/3 difference", pairs[:, 0] - pairs[:, 1], frames)
    kinds = np.concatenate([step_kinds(record) for record in records])
    legend = ", ".join(f"{place} {name}" for place, name in enumerate(STEPS))
    logger.histogram(f"walks/steps: {legend}", kinds, frames)
    hops = np.concatenate([record.hops[record.accepted] for record in records])
    logger.histogram("walks/hops of accepted requests", hops, frames)
    for name, weights in loss.named_parameters():
        logger.histogram(f"weights/{name}", weights, frames)
        if weights.grad is not None:
            logger.histogram(f"gradients/{name}", weights.grad, frames)


def draw_pictures(record: RunRecord, references: References | None, logger: RunLogger, frames: int) -> None:
    """Log the network, coloured by use, and some walks of the agent's ``record`` beside those of the exact search."""
    logger.figure("network/utilisation", draw_utilisation(record, "agent"), frames)
    walks = {} if references is None else references.walks
    for number, (request, exact) in enumerate(walks.items(), 1):
        service = record.scenario.catalogue.types[int(record.workload.service[request])].name
        both = {"agent": walk_of(record, request), EXACT: exact}
        figure = draw_walks(record.scenario, title_of(record, request), both)
        logger.figure(f"walks/{number} {service}", figure, frames)
