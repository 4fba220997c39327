"""Small steps that every recipe takes before its loop."""

from __future__ import annotations

import hashlib
import random
import re
import signal
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig

from nfv_torchrl.errors import ScenarioError, one_line
from nfv_torchrl.folders import check_place, refuse_files
from nfv_torchrl.losses.torchrl_losses import torchrl_loss
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.targets import OF_HYDRA
from nfv_torchrl.settings.torchrl_losses import served
from nfv_torchrl.training.cli import STOPS


def choose_device(name: str) -> torch.device:
    """``auto``: the GPU if there is one, else the CPU; or the device named.

    Raises:
        ScenarioError: no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return check_device("device", name, "try device=auto")


def check_device(key: str, name: str, remedy: str) -> torch.device:
    """The device that the setting ``key`` names.

    Raises:
        ScenarioError: no such device, with what to do.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as error:
        raise ScenarioError(f"{key}: {name} cannot be used here ({one_line(error)}); {remedy}") from error
    return device


def seed_everything(seed: int) -> None:
    """Seed the global random numbers that libraries draw from; the environment has streams of its own."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002  libraries draw from the global state
    torch.manual_seed(seed)


def set_threads(threads: int) -> None:
    """Threads of batched torch operations. Two on two busy cores can be far slower than one, so it is a choice."""
    if threads < 1:
        raise ScenarioError(f"threads is {threads}; at least one is needed")
    torch.set_num_threads(threads)


def make_loss(config: DictConfig, network: NetworkFactory, sizes: Sizes) -> Any:
    """The loss that a recipe's ``loss`` names: a ``RequestLoss``, or a class of TorchRL's with what it needs.

    Raises:
        ScenarioError: a class of TorchRL's that does not serve here, or settings that it does not take.
    """
    kind = get_object(config["_target_"])
    if served(kind) is None:
        return instantiate(config, network=network, sizes=sizes)
    settings = instantiate({key: value for key, value in config.items() if key not in OF_HYDRA})
    return torchrl_loss(kind, network, sizes, **settings)


LONGEST_NAME = 120
_PLAIN = re.compile(r"([A-Za-z0-9.]+(?:_[A-Za-z0-9.]+)*)=([A-Za-z0-9.-]+(?:_[A-Za-z0-9.-]+)*)")
_OF_EVERY_JOB = ("run_dir=", "output=", "resume=")


def run_folder(value: Any, key: str = "run_dir") -> Path:
    """The folder that the setting ``key`` names, or in a sweep a folder of the job's own below it.

    A job is named after its overrides in their order, ``runs/sweep/loss-n_step__seed-1``, so that the same command with
    ``resume=true`` finds it again, and so that it can be typed.

    Raises:
        ScenarioError: no command may own such a folder.
    """
    path = check_place(key, value)
    job = job_name()
    if job:
        refuse_files(key, path)
    return path / job if job else path


def run_file(value: Any, key: str = "output") -> Path:
    """The same for a file: in a sweep ``runs/table-seed-1.csv`` instead of ``runs/table.csv``."""
    path = check_place(key, value)
    job = job_name()
    return path.with_name(f"{path.stem}-{job}{path.suffix}") if job else path


def job_name() -> str:
    """What tells this job of a sweep from the others, different for different overrides; empty without a sweep.

    Values with other characters than letters, digits, ``.``, ``_`` and ``-``, and long names, end in a number that
    stands for all of it.
    """
    if not HydraConfig.initialized() or HydraConfig.get().mode != RunMode.MULTIRUN:
        return ""
    given = [text for text in HydraConfig.get().overrides.task if not text.startswith(_OF_EVERY_JOB)]
    plain = [_PLAIN.fullmatch(text) for text in given]
    name = "__".join(re.sub(r"[^A-Za-z0-9.-]+", "_", text.replace("=", "-", 1)).strip("_") for text in given) or "job"
    if all(plain) and len(name) <= LONGEST_NAME:
        return name
    digest = hashlib.sha256("\0".join(given).encode()).hexdigest()[:12]
    return f"{name[: LONGEST_NAME - 14].rstrip('_')}__{digest}"


def quote(value: str | Path) -> str:
    """``value`` as Hydra's command line takes it, whatever is in it: blanks, commas, ``=``, quotes, letters."""
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", str(value))
    text = re.sub(r"(\\*)'", r"\1\1\'", text)
    tail = len(text) - len(text.rstrip("\\"))
    return f"'{text}{text[len(text) - tail :]}'"


class StopRequest:
    """Ctrl-C, SIGTERM or SIGUSR1 asks for an orderly stop after the current iteration.

    A second Ctrl-C stops at once; the other two may come as often as a cluster sends them, also while the run saves and
    says how to go on, which belongs within.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> StopRequest:
        self._before = {number: signal.signal(number, self._ask) for number in STOPS}
        return self

    def __exit__(self, *error: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = True
