"""A training on a Ray cluster of three nodes, each of processes of its own, one of which is killed.

It takes minutes, so it runs where it is asked for, and also shows how a cluster is started:

    NFV_TORCHRL_SLOW=1 python -m pytest tests/training/test_ray_cluster.py -s
"""

import importlib.util
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING, command

pytestmark = [
    pytest.mark.skipif(not os.environ.get("NFV_TORCHRL_SLOW"), reason="takes minutes: NFV_TORCHRL_SLOW=1"),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed: pip install -e .[ray]"),
]
SECONDS = 600
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_raylet_start_wait_time_s": str(SECONDS),  # on a busy machine
    "RAY_AUTH_MODE": "token",  # Ray wants both where a token is on the machine, and says so in a traceback
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
}


def free_port() -> int:
    with socket.socket() as any_port:
        any_port.bind(("127.0.0.1", 0))
        return any_port.getsockname()[1]


@contextmanager
def node(*arguments: str):
    """What ``ray start`` starts, as long as the block lasts."""
    start = "from ray.scripts.scripts import main; main()"
    fixed = ["--disable-usage-stats", f"--object-store-memory={100 * 2**20}"]
    process = subprocess.Popen(
        [sys.executable, "-c", start, "start", *arguments, *fixed, "--block"],
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        kill(process)


def kill(process: subprocess.Popen) -> None:
    """SIGKILL to a node and to all that it has started: its raylet, and the actors there."""
    import psutil

    if process.poll() is None:
        for each in [*psutil.Process(process.pid).children(recursive=True), process]:
            each.kill()
        process.wait()


def until(condition) -> None:
    end = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.2)


def nodes_alive(address: str) -> int:
    listed = "import ray, sys; ray.init(sys.argv[1], logging_level=40); print(sum(n['Alive'] for n in ray.nodes()))"
    asked = subprocess.run(
        [sys.executable, "-c", listed, address], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    return int(asked.stdout.split()[-1]) if asked.returncode == 0 else 0


@pytest.fixture(scope="module")
def cluster():
    """The address of a cluster, and the nodes that work there, of one core each; the head has none."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # short: sockets lie there
    address = f"127.0.0.1:{(port := free_port())}"
    with ExitStack() as stack:
        stack.enter_context(
            node("--head", f"--port={port}", "--num-cpus=0", "--include-dashboard=false", f"--temp-dir={folder}")
        )
        until(lambda: nodes_alive(address) == 1)
        # Each with an address of its own: of two nodes with the same one, a driver may belong to the wrong.
        # One after the other: two that start at once take the same sockets, and one of them is never there.
        workers = []
        for number in (2, 3):
            here = ["--num-cpus=1", f"--node-ip-address=127.0.0.{number}"]
            workers.append(stack.enter_context(node(f"--address={address}", *here)))
            until(lambda number=number: nodes_alive(address) == number)
        print(f"\na cluster of 3 nodes at {address}")
        yield address, workers
    shutil.rmtree(folder, ignore_errors=True)


def dqn(run_dir: Path, address: str, *more: str) -> subprocess.Popen:
    settings = [f"run_dir={run_dir}", "collector=ray", f"collector.address={address}", "eval.interval=0"]
    return subprocess.Popen(
        command("dqn.py", "preset=mlp", *TINY_SCENARIO, *TINY_TRAINING, *settings, *more),
        env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(run: subprocess.Popen) -> tuple[int, str, str]:
    out, err = run.communicate(timeout=SECONDS)
    return run.returncode, out, err


def frames(run_dir: Path) -> list[int]:
    return sorted(int(path.stem.split("_")[1]) for path in run_dir.glob("checkpoint_*.pt"))


def test_a_run_on_a_cluster_ends_and_another_outlives_a_node(cluster, tmp_path):
    address, workers = cluster
    code, out, err = ended(dqn(tmp_path / "whole", address))
    assert code == 0, err
    assert frames(tmp_path / "whole")[-1] == 960

    lost = tmp_path / "lost"
    run = dqn(lost, address, "collector.total_frames=1_000_000")
    until(lambda: frames(lost) or run.poll() is not None)
    begun = time.monotonic()
    kill(workers[0])
    code, out, err = ended(run)
    print(f"a node was killed; {time.monotonic() - begun:.0f} s later the run ended with code {code}:\n{err}")
    assert code == 2
    assert "Traceback" not in err and err.count("collector: a worker failed") == 1
    reached = frames(lost)[-1]

    # One node of one core is left, for two workers.
    code, out, err = ended(dqn(lost, address, f"collector.total_frames={reached + 320}", "resume=true"))
    assert code == 2 and "collector.workers: 2 need 2 cores, and the cluster has 1" in err
    code, out, err = ended(
        dqn(lost, address, f"collector.total_frames={reached + 320}", "resume=true", "collector.cpus=0.5")
    )
    assert code == 0, err
    assert "The environments begin anew" in out and frames(lost)[-1] == reached + 320
