"""What Numba caches on disk is compiled again when a module that it was compiled from has changed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nfv_torchrl.simulator import compiled, kernels

CONSTANT = "from house.simulator.compiled import part\nLEVEL = {level}\n@part\ndef level():\n    return LEVEL\n"
CALLER = (
    "from house.simulator.compiled import kernel\nfrom house.simulator.low import level\n"
    "@kernel\ndef twice():\n    return 2 * level()\n"
)
RUN = "from house.simulator.high import twice; print(twice(), sum(twice.stats.cache_hits.values()))"


def run(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """What ``twice`` returned and whether it came from the cache, printed in a process of its own."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"} | environment
    return subprocess.run([sys.executable, "-c", RUN], cwd=folder, env=environment, capture_output=True, text=True)


def call(folder: Path) -> list[str]:
    answer = run(folder, NUMBA_CACHE_DIR=str(folder / "cache"))
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.split()


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A package with two kernels."""
    package = tmp_path / "house" / "simulator"
    package.mkdir(parents=True)
    shutil.copy(compiled.__file__, package)
    (package / "high.py").write_text(CALLER)
    (package / "low.py").write_text(CONSTANT.format(level=1))
    return tmp_path


def test_change_in_a_module_below_compiles_anew(house: Path) -> None:
    assert call(house) == ["2", "0"]
    assert call(house) == ["2", "1"]
    (house / "house" / "simulator" / "low.py").write_text(CONSTANT.format(level=2))
    assert call(house) == ["4", "0"]


SHARED = (
    "from house.simulator.compiled import part, shared\n@shared\ndef square(x):\n    return x * x\n"
    "@part\ndef level():\n    total = 0\n    for k in range(4):\n        total = square(total + k)\n"
    "    return total + square(5)\n"
)
COUNT = (
    "from house.simulator.high import twice; from house.simulator.low import square; "
    "print(twice(), sum(twice.stats.cache_hits.values()), len(square.overloads), sum(square.stats.cache_hits.values()))"
)


def count(folder: Path) -> list[str]:
    """What ``twice`` returned, whether it came from the cache, how often ``square`` is there, and whether cached."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-c", COUNT]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    ).stdout.split()


def test_shared_code_is_compiled_once_and_its_callers_follow_it(house: Path) -> None:
    """Once, also for constants and for what a loop counts; a kernel whose shared code is another one is made anew."""
    (house / "house" / "simulator" / "low.py").write_text(SHARED)
    assert count(house) == ["338", "0", "1", "0"]
    assert count(house) == ["338", "1", "1", "1"]
    for file in (house / "cache").rglob("*square*"):
        file.unlink()
    # Compiled first it has another name than compiled last; the kernel on disk must not look for that.
    alone = "from house.simulator.low import square; from numba import int64; square.compile((int64,))"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(house / "cache")}
    subprocess.run([sys.executable, "-c", alone], cwd=house, env=environment, check=True)
    assert count(house) == ["338", "0", "1", "1"]
    assert count(house) == ["338", "1", "1", "1"]


def flipped(data: bytes) -> bytes:
    """One bit of machine code changed."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def test_a_damaged_cache_file_is_compiled_anew(house: Path) -> None:
    assert call(house) == ["2", "0"]
    damages = [("nbi", lambda data: data[:20]), ("nbi", lambda data: b""), ("nbc", lambda data: data[:200]),
               ("nbc", flipped)]  # fmt: skip
    for ending, damage in damages:
        files = list((house / "cache").rglob(f"*twice*.{ending}"))
        assert files
        for file in files:
            file.write_bytes(damage(file.read_bytes()))
        assert call(house) == ["2", "0"]
    assert call(house) == ["2", "1"]


def test_without_a_writable_cache_it_runs_and_says_so_once(house: Path) -> None:
    (house / "house" / "simulator" / "__pycache__").write_text("no folder can be made here")
    temporary = house / "tmp"
    temporary.mkdir()
    for hits in ("0", "1"):
        done = run(house, HOME="/dev/null", TMPDIR=str(temporary), XDG_CACHE_HOME="/dev/null")
        assert done.stdout.split() == ["2", hits]
        assert len(done.stderr.splitlines()) == 1 and "set NUMBA_CACHE_DIR" in done.stderr
    # A folder that others can write to is not trusted: what lies in it would be run.
    next(temporary.iterdir()).chmod(0o777)
    done = run(house, HOME="/dev/null", TMPDIR=str(temporary), XDG_CACHE_HOME="/dev/null")
    assert done.stdout.split() == ["2", "0"] and "compiled anew each time" in done.stderr


def test_without_compilation_the_same_steps_are_taken(capsys) -> None:
    script = (
        "import torch; from nfv_torchrl.env import NFVEnv; from nfv_torchrl.scenario import paper_scenario; "
        "from nfv_torchrl.training.random_policy import RandomPolicy; torch.manual_seed(0); "
        "steps = NFVEnv(paper_scenario(horizon=3), 2).rollout(9, RandomPolicy()); "
        "print(tuple(steps.shape), float(steps['next', 'observation'].double().sum()))"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    exec(script, {})
    assert done.stdout == capsys.readouterr().out and done.stdout.startswith("(2, 9)")


def test_kernels_are_stamped_with_their_sources() -> None:
    stamp = kernels.step_env._cache._cache_file._source_stamp
    assert stamp[1] == compiled.source_stamp(Path(kernels.__file__))
