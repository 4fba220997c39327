"""Workers of every kind: the same results, errors told, a killed worker named, and nobody outlives the command."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from inprocess import call
from omegaconf import OmegaConf
from tiny import ROOT, TINY_SCENARIO

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.experiments import computing, work
from nfv_torchrl.experiments.cells import CellStore, make_cell
from nfv_torchrl.experiments.computing import chained, compute
from nfv_torchrl.parallel import Dask, Joblib, Ray, clusters
from nfv_torchrl.settings.recipes import TunePricedSettings, read_settings

WORLD = {"substrate": {"nodes": 5}, "horizon": 40, "arrival_rate": 4.0, "mean_lifetime": 40.0}


def needs(package: str):
    """Runs where the package is installed."""
    lacks = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(lacks, reason=f"{package} is not installed: pip install -e .[dev]")


LOCAL = [
    pytest.param(Joblib(jobs=2), id="loky"),
    pytest.param(Joblib(jobs=2, backend="threading"), id="threading"),
]
CLUSTERS = [
    pytest.param(Ray(jobs=2), id="ray", marks=needs("ray")),
    pytest.param(Dask(jobs=2), id="dask", marks=needs("distributed")),
]


def cells():
    """Two methods and a bound, and one that fails."""
    good = {"_target_": "nfv_torchrl.methods.RandomMethod", "name": "random_feasible", "mask": "feasible"}
    spec = {"scenario": WORLD, "seeds": [0, 1], "training": None}
    return [
        make_cell("evaluation", "good", {**spec, "method": good}),
        make_cell("bound", "bound", {"scenario": WORLD, "seeds": [0]}),
        make_cell("evaluation", "bad", {**spec, "method": {**good, "mask": "nonsense"}}),
    ]


def results(folder):
    """What is in the cells, but for measured times."""
    found = {path.name: json.loads(path.read_text()) for path in (folder / "cells").glob("*.json")}
    for cell in found.values():
        for run in cell["result"].get("metrics", {}).values():
            assert run.pop("decision_seconds") > 0 and run.pop("decisions_per_second") > 0
    return found


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """What one process computes."""
    folder = tmp_path_factory.mktemp("one")
    failures = compute(cells(), CellStore(folder), workers=Joblib(jobs=1))
    return failures, results(folder)


@pytest.mark.parametrize("workers", LOCAL)
def test_cells_are_the_same_whoever_computes_them(workers, tmp_path, expected):
    failures = compute(cells(), CellStore(tmp_path), workers=workers)
    assert (failures, results(tmp_path)) == expected
    assert "nonsense" in failures[cells()[2].key] and len(expected[1]) == 2
    assert not (tmp_path / ".workers.lock").exists()


@pytest.mark.parametrize("workers", CLUSTERS)
def test_a_cluster_gives_results_and_the_task_s_own_error(workers):
    with workers:
        # A function that workers have without the imports of this file, which take seconds in each.
        outcomes = {outcome.place: outcome for outcome in workers.unordered(math.sqrt, [4, -1, 9])}
    assert outcomes[0].unwrap() == 2 and outcomes[2].unwrap() == 3
    with pytest.raises(ValueError) as caught:
        outcomes[1].unwrap()
    assert "in attempt" in caught.value.__notes__[0]  # it was raised in another process


def inverse(number: float) -> float:
    return 1 / number


def test_results_come_in_order_and_the_error_is_the_task_s_own():
    with Joblib(jobs=2) as workers:
        assert list(workers.map(inverse, [4, 2, 1])) == [0.25, 0.5, 1]
        with pytest.raises(ZeroDivisionError) as caught:
            list(workers.map(inverse, [1, 0]))
    assert "in inverse" in caught.value.__notes__[0]


def test_chains_wait_for_what_they_need():
    train, other = (make_cell("training", name, {"name": name}) for name in ("train", "other"))
    test = make_cell("evaluation", "test", {}, [train])
    again = make_cell("evaluation", "again", {"x": 1}, [test, train])
    both = make_cell("evaluation", "both", {"x": 2}, [train, other])
    last = make_cell("evaluation", "last", {"x": 3}, [both])
    assert chained([train, test, other, again, both, last]) == [[(train, test, again), (other,)], [(both, last)]]
    assert chained([test, both]) == [[(test,), (both,)]]  # their needs are there


def test_what_needs_a_failed_cell_is_not_tried(tmp_path, monkeypatch):
    tried = []
    monkeypatch.setitem(work.WORK, "presence", lambda cell, store: tried.append(cell) or 1 / 0)
    first = make_cell("presence", "first", {})
    second = make_cell("presence", "second", {"x": 1}, [first])
    other = make_cell("presence", "other", {"x": 2})
    both = make_cell("presence", "both", {"x": 3}, [first, other])
    failures = compute([second, both], CellStore(tmp_path), workers=Joblib(jobs=1))
    assert tried == [first, other] and "division" in failures[first.key]
    assert failures[second.key] == failures[both.key] == f"needs {first.key}, which failed"


def test_a_signal_lets_work_end_and_starts_no_more(tmp_path, monkeypatch):
    begun = []

    def slow(cell, store):
        begun.append(cell)
        os.kill(os.getpid(), signal.SIGUSR1)
        time.sleep(0.1)
        return {}

    monkeypatch.setitem(work.WORK, "presence", slow)
    wanted = [make_cell("presence", f"cell{number}", {"number": number}) for number in range(3)]
    store = CellStore(tmp_path)
    with pytest.raises(KeyboardInterrupt) as stopped:
        compute(wanted, store, workers=Joblib(jobs=1))
    assert stopped.value.args == (signal.SIGUSR1,) and begun == wanted[:1] and store.has(wanted[0])
    assert compute(wanted[:1], store, workers=Joblib(jobs=1)) == {}


ORPHANS = """
import os, time
from nfv_torchrl.parallel import Joblib
def write_pid(folder):
    open(folder + "/" + str(os.getpid()) + ".pid", "w").close()
    time.sleep(60)
with Joblib(jobs=2) as workers:
    list(workers.map(write_pid, [{folder!r}] * 2))
"""


def test_workers_do_not_outlive_a_killed_parent(tmp_path):
    script = ORPHANS.format(folder=str(tmp_path))
    parent = subprocess.Popen([sys.executable, "-c", script])
    _until(lambda: len(list(tmp_path.glob("*.pid"))) == 2)
    parent.kill()
    parent.wait()
    workers = [Path("/proc", path.stem) for path in tmp_path.glob("*.pid")]
    _until(lambda: not any(map(_alive, workers)), seconds=20)


def _alive(process: Path) -> bool:
    try:
        return "\nState:\tZ" not in (process / "status").read_text()
    except OSError:
        return False


def _until(condition, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_what_is_not_installed_is_named(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(clusters.importlib, "import_module", missing)
    for workers, extra in ((Ray(), "ray"), (Dask(), "dask")):
        with pytest.raises(ScenarioError, match=rf"nfv_torchrl\[{extra}\].*parallel=joblib"):
            workers.start()


@needs("distributed")
def test_a_cluster_that_is_not_there_is_named():
    import dask

    soon = dask.config.set({"distributed.comm.timeouts.connect": "0.5s"})
    with soon, pytest.raises(ScenarioError, match=r"parallel\.address: tcp://127\.0\.0\.1:9"):
        Dask(address="tcp://127.0.0.1:9").start()


@pytest.mark.parametrize(
    ("parallel", "named"),
    [
        ({"jobs": 0}, r"parallel\.jobs"),
        ({"address": "auto"}, r"parallel\.address: unknown key"),
        ({"_target_": "os.getcwd"}, "parallel"),
        ({"_target_": "collections.OrderedDict"}, "no method 'unordered'"),
    ],
)
def test_settings_of_workers_are_checked(parallel, named):
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = OmegaConf.to_container(compose("tune_priced"), resolve=True)
    read_settings(config, TunePricedSettings)
    with pytest.raises(ScenarioError, match=named):
        read_settings({**config, "parallel": {**config["parallel"], **parallel}}, TunePricedSettings)
    with pytest.raises(ScenarioError, match=r"jobs: was renamed to parallel\.jobs"):
        read_settings({**config, "jobs": 1}, TunePricedSettings)


def test_an_evaluation_is_the_same_with_two_workers(tmp_path, capsys):
    tables = []
    for jobs in (1, 2):
        output = tmp_path / str(jobs)
        call(
            "evaluate", "method=[random_feasible,greedy]", "seeds=2", "bounds=true", f"parallel.jobs={jobs}",
            f"output={output}", *TINY_SCENARIO,
        )  # fmt: skip
        tables.append({path.relative_to(output): path.read_bytes() for path in output.rglob("decisions.jsonl")})
        tables[-1]["bounds"] = [line for line in (output / "summary.csv").read_text().splitlines() if "bound" in line]
    assert tables[0] == tables[1] and len(tables[0]) == 5 and tables[0]["bounds"]


def test_a_killed_worker_is_named_with_the_remedy(tmp_path, monkeypatch):
    with Joblib(jobs=2) as workers, pytest.raises(ScenarioError, match=r"killed.*parallel\.jobs"):
        list(workers.map(signal.raise_signal, [signal.SIGKILL]))
    monkeypatch.setattr(computing, "work_chain", _killed_chain)
    wanted = [make_cell("presence", f"cell{number}", {"number": number}) for number in range(4)]
    failures = compute(wanted, CellStore(tmp_path), workers=Joblib(jobs=2))
    told = [failures[cell.key] for cell in wanted]
    assert told == [computing.KILLED] * 2 + [computing.LEFT] * 2


def _killed_chain(chain, *, store, leash):
    signal.raise_signal(signal.SIGKILL)
