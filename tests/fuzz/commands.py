"""Random settings for every recipe: composed and checked, and some of them run for real in a folder of their own."""

from __future__ import annotations

import os
import random
import signal
import sys
from functools import cache, partial
from pathlib import Path

from fuzz.arena import Case
from hydra import compose, initialize_config_dir
from inprocess import recipe
from omegaconf import OmegaConf
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.recipes import RECIPES, read_settings
from nfv_torchrl.training.overrides import explain

RUN = {
    "dqn": ["preset=mlp", *TINY_SCENARIO, *TINY_TRAINING, "run_dir=run"],
    "policy_gradient": [*TINY_SCENARIO, "collector.num_envs=4", "collector.steps=8", "collector.total_frames=128",
                        "eval.seeds=[1000]", "logger.figures=false", "run_dir=run"],
    "evaluate": [*TINY_SCENARIO, "method=[random,greedy]", "seeds=1", "output=run"],
}  # fmt: skip
"""Recipes that are run for real, and how to make them small. What the case sets comes after that."""
LONGEST = 20
"""Seconds after which a command that goes on is taken to work."""
VALUES = [
    "-1", "0", "1", "2", "0.5", "-0.5", "1.5", "null", "true", "false", "abc", "''", "[]", "[-1]", "[1,2]", "[1,1]",
    "{}", "{a:1}", "nan", "inf", "-inf", "1e400", "4294967296", "-4294967296", "18446744073709551616", "1e18", "no",
    "'no'", "..", ".", "/", "'a b'", "ümlaut", "${seed}", "${nothing}", "${oc.env:HOME}", "[[1]]", "[null]", "???",
    "0x10", "1_000",
]  # fmt: skip
ODD = ["+nothing=1", "+scenario.nothing=1", "+buffer.sampler=x", "~seed", "~scenario", "seed", "=1", "loss=nothing",
       "scenario=nothing", "method=[nothing]", "nothing=1", "sceanrio.horizon=5", "hydra.run=1", "--nothing", "a=b=c",
       "scenario.substrate.nodes=", "seed=1,2", "+seed=1", "++x=1", "scenario.services.web=null"]  # fmt: skip


class TooLong(BaseException):
    """Still at work after ``LONGEST`` seconds."""


def overrides_of(rng: random.Random, name: str) -> list[str]:
    """One to three settings of a recipe, or things that look like one."""
    keys = _keys(name)
    return [
        rng.choice(ODD) if rng.random() < 0.15 else f"{rng.choice(keys)}={rng.choice(VALUES)}"
        for _ in range(rng.choice([1, 1, 1, 2, 3]))
    ]


@cache
def _keys(name: str) -> list[str]:
    """All keys of a recipe at every depth."""
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = OmegaConf.to_container(compose(name), resolve=False)
    found: list[str] = []

    def walk(node: object, prefix: str) -> None:
        for key, value in node.items() if isinstance(node, dict) else ():
            found.append(f"{prefix}{key}")
            walk(value, f"{prefix}{key}.")

    walk(config, "")
    return found


def check(name: str, number: int, folder: Path) -> None:
    """Settings composed and checked as a recipe does before it starts."""
    overrides = overrides_of(random.Random(f"{name}:{number}"), name)
    try:
        with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
            config = compose(name, overrides)
    except Exception as error:  # whatever Hydra raises, as on the command line
        raise ScenarioError(explain(error, ROOT / "recipes", name, overrides)) from error
    read_settings(config, RECIPES[name])


def run(name: str, number: int, folder: Path) -> None:
    """A recipe started for real where an older run is: refused, it leaves that run and the folder as they were."""
    overrides = overrides_of(random.Random(f"{name}:{number}"), name)
    older = {"run/config.yaml": "run_dir: run\nscenario: {}\n", "run/best.pt": "weights"} if name != "evaluate" else {}
    for path, text in older.items():
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(text)
    code, said = _start(name, [*RUN[name], *overrides], folder)
    assert "Traceback" not in said, f"{overrides}: {said[-2500:]}"
    assert code in (0, 2), f"{overrides}: exit code {code}: {said[-500:]}"
    if code == 2:
        left = {
            str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file() and p.name != "said"
        }
        assert left == older, f"{overrides}: refused, yet {sorted(left.keys() ^ older.keys())} changed"
        last = said.strip().splitlines()[-1] if said.strip() else ""
        assert last.startswith("error: ") and said.count("error: ") == 1, f"{overrides}: {said[-1000:]}"
        raise ScenarioError(last)


def _start(name: str, overrides: list[str], folder: Path) -> tuple[int, str]:
    """Exit code and stderr of a recipe, run in this process and in ``folder``."""
    os.chdir(folder)
    sys.argv = [str(ROOT / "recipes" / f"{name}.py"), *overrides]
    signal.signal(signal.SIGALRM, _too_long)
    code = 0
    with (folder / "said").open("w+") as sys.stderr, Path(os.devnull).open("w") as sys.stdout:
        signal.alarm(LONGEST)
        try:
            recipe(name).main()
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        except TooLong:
            pass
        signal.alarm(0)
        sys.stderr.flush()
    return code, (folder / "said").read_text()


def _too_long(signal_number: int, frame: object) -> None:
    raise TooLong


COMPOSED = sorted(set(RECIPES) - {"milp_gap"})
CHECKS: dict[str, Case] = {f"check {name}": partial(check, name) for name in COMPOSED}
RUNS: dict[str, Case] = {f"run {name}": partial(run, name) for name in RUN}


def warm_up() -> None:
    """Compose and import in the parent what every case needs."""
    for name in COMPOSED:
        _keys(name)
    for name in RUN:
        recipe(name)
