"""What a run writes for TensorBoard, read from its event files: every chart has its lines, and none is flat."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
import torch
from inprocess import call
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2
from tiny import TINY_TRAINING

from nfv_torchrl.evaluation.metrics import compute_metrics, paired_cost
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.layout import charts, written_always
from nfv_torchrl.training.references import FILE, References, reference_methods
from nfv_torchrl.vocabulary import without_row

EVALUATIONS = 4
APART = ("bound", "greedy", "myopic_optimal", "random_feasible")
"""Folders below that of a run, with the lines that its own are read against."""
SCENARIO = [
    "scenario.substrate.nodes=6",
    "scenario.substrate.vms_max=2",
    "scenario.horizon=60",
    "scenario.arrival_rate=8",
    "scenario.mean_lifetime=60",
]
SETTINGS = [
    "preset=mlp", *SCENARIO, *TINY_TRAINING, "logger.figures=true", "eval.interval=12", "collector.total_frames=1152",
    "eval.seeds=[1000,1001]",
]  # fmt: skip


def events_of(folder) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0, "histograms": 0})
    events.Reload()
    return events


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("watched") / "run"
    call("dqn", f"run_dir={folder}", *SETTINGS)
    return folder


@pytest.fixture(scope="module")
def events(run):
    return events_of(run)


def layout_of(events: EventAccumulator) -> layout_pb2.Layout:
    (event,) = events.Tensors("custom_scalars__config__")
    return layout_pb2.Layout.FromString(event.tensor_proto.string_val[0])


def test_every_line_of_the_layout_is_there(run, events):
    tags = {*events.Tags()["scalars"]} | {tag for name in APART for tag in events_of(run / name).Tags()["scalars"]}
    charts = [chart for category in layout_of(events).category for chart in category.chart]
    assert charts[0].title.startswith("AAR: the agent")
    assert all(len(chart.title) <= 42 for chart in charts)  # one line above the chart
    for chart in charts:
        for pattern in chart.multiline.tag:
            if "entropy" not in pattern:  # of policies that have one
                assert any(re.match(pattern, tag) for tag in tags), (chart.title, pattern)
    assert charts[0].multiline.tag == ["eval/aar$"]
    assert all("eval/aar" in events_of(run / name).Tags()["scalars"] for name in APART)
    assert not without_row(tags)


def test_frame_0_is_evaluated_and_reference_lines_span_the_chart(run, events):
    frames = [event.step for event in events.Scalars("eval/aar")]
    assert frames[0] == 0 and len(frames) == EVALUATIONS and frames[-1] == 1152
    for name in APART:
        points = events_of(run / name).Scalars("eval/aar")
        assert [event.step for event in points] == frames and len({event.value for event in points}) == 1


def test_no_series_is_constant_but_those_that_others_are_read_against(events):
    flat = [tag for tag in events.Tags()["scalars"] if len({event.value for event in events.Scalars(tag)}) < 2]
    assert all(written_always(tag) for tag in flat), flat
    assert "eval/rho" not in events.Tags()["scalars"]


def test_the_references_are_what_an_evaluation_finds(run, events):
    config = load_file(CheckpointFolder(run).files()[-1])["config"]
    scenario = Scenario.from_config(config["scenario"])
    by_method = {method.name: run_method(scenario, method, [1000, 1001]) for method in reference_methods()}
    for name, records in by_method.items():
        expected = np.mean([compute_metrics(record)["aar"] for record in records])
        assert events_of(run / name).Scalars("eval/aar")[0].value == pytest.approx(expected)
    known = References.of(run, scenario, [1000, 1001], report=lambda answered: pytest.fail("computed again"))
    greedy, exact = by_method["greedy"], by_method["myopic_optimal"]
    ratios = [paired_cost(mine, other) for mine, other in zip(greedy, exact, strict=True)]
    assert known.paired_costs(greedy) == pytest.approx({"greedy": 1.0, "myopic_optimal": np.mean(ratios)})
    last = events.Scalars("eval/paired_cost/greedy")[-1].value
    assert events_of(run / "greedy").Scalars("eval/paired_cost")[-1].value == last
    bound, exact = (events_of(run / name).Scalars("eval/aar")[0].value for name in ("bound", "myopic_optimal"))
    assert bound >= exact


def test_rejections_are_stacked(events):
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith("eval/rejected_stacked/")]
    assert tags
    aar = {event.step: event.value for event in events.Scalars("eval/aar")}
    lines = [{event.step: event.value for event in events.Scalars(tag)} for tag in tags]
    for step, accepted in aar.items():
        heights = [line[step] for line in lines if step in line]
        assert all(low <= high for low, high in pairwise(sorted(heights)))
        if heights:
            assert max(heights) == pytest.approx(1 - accepted, abs=1e-6)


def test_text_pictures_histograms_and_hyperparameters(run, events):
    said = [event.tensor_proto.string_val[0].decode() for event in events.Tensors("2 how it stands/text_summary")]
    assert len(said) == EVALUATIONS and said[0].startswith("Before training, the agent accepts")
    (page,) = events.Tensors("1 what you see/text_summary")
    for words in ("rho", "`myopic_optimal`", "Custom Scalars"):
        assert words in page.tensor_proto.string_val[0].decode()
    pictures = events.Tags()["images"]
    assert "network/utilisation" in pictures and sum(tag.startswith("walks/") for tag in pictures) == 5
    histograms = events.Tags()["histograms"]
    assert {"values/1_of_the_action_taken", "values/2_of_the_best_other_action", "walks/hops_of_accepted_requests"} <= {
        tag.replace(" ", "_") for tag in histograms
    }
    assert any(tag.startswith("weights/") for tag in histograms)
    assert any(tag.startswith("gradients/") for tag in histograms)
    data = events.summary_metadata["_hparams_/experiment"].plugin_data.content
    infos = plugin_data_pb2.HParamsPluginData.FromString(data).experiment
    names = [info.display_name for info in infos.hparam_infos]
    assert [info.name for info in infos.hparam_infos][:2] == ["00 loss", "01 network"]  # which TensorBoard sorts by
    assert names[:8] == ["loss", "network", "lr", "gamma", "seed", "frames", "buffer", "scenario"]
    metrics = [info.name.tag for info in infos.metric_infos]
    assert metrics[0] == "eval/aar" and set(metrics) <= set(events.Tags()["scalars"])


def test_the_file_of_a_default_run_stays_small(run):
    """A default run has 15 evaluations and 58 log lines of as many series; pictures of 10 nodes are a little larger."""
    (file,) = run.glob("events.out.tfevents.*")
    assert file.stat().st_size * 15 / EVALUATIONS < 5e6


def test_evaluations_change_nothing_that_is_learned(run, tmp_path):
    folder = tmp_path / "run"
    call("dqn", f"run_dir={folder}", *SETTINGS, "eval.interval=0")
    ours, others = (load_file(CheckpointFolder(each).files()[-1]) for each in (run, folder))
    for key, value in ours["loss"].items():
        assert torch.equal(value, others["loss"][key]), key
    assert not (folder / FILE).exists()


def test_a_resumed_run_writes_the_same_points_and_computes_no_reference_again(run, events, tmp_path):
    folder = tmp_path / "run"
    call("dqn", f"run_dir={folder}", *SETTINGS, "collector.total_frames=768")
    before = (folder / FILE).stat().st_mtime_ns
    call("dqn", f"run_dir={folder}", *SETTINGS, "resume=true")
    assert (folder / FILE).stat().st_mtime_ns == before
    again = events_of(folder)

    def points(of: EventAccumulator) -> dict[str, list]:
        tags = [tag for tag in of.Tags()["scalars"] if not tag.startswith("speed/")]
        return {tag: [(event.step, event.value) for event in of.Scalars(tag)] for tag in tags}

    assert points(again) == points(events)
    steps = [event.step for event in again.Tensors("2 how it stands/text_summary")]
    assert steps == [event.step for event in events.Tensors("2 how it stands/text_summary")]
    layout_of(again)  # one, not two


@pytest.mark.parametrize("apart", [False, True])
def test_where_weights_are_chosen_on_held_out_networks_the_first_charts_show_it(apart):
    with_them, without = (charts(evaluated=True, apart=apart, held_out=held_out) for held_out in (True, False))
    first = next(iter(with_them))
    assert set(with_them[first]) - set(without[first]) == {
        "AAR on held-out networks",
        "their paired cost: agent / myopic_optimal",
    }
    assert all(with_them[other] == without[other] for other in with_them if other != first)
    assert written_always("eval/held_out_aar") and written_always("eval/aar/web")
