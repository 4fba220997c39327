"""Saved states of environments, damaged in one place each, as a stranger's checkpoint might be.

Run it for as many as you like: ``python tests/simulator/mutations.py 1000``. A mutation that is accepted is played.
"""

from __future__ import annotations

import copy
import random
import sys
from collections import Counter

import numpy as np
import torch

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.nfvdeep import NFVdeepEnv
from nfv_torchrl.observations import CandidateObservation, MemoryObservation, RequestObservation
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator.state import ENV_DTYPE

EXTREMES = (-1, -2, 1, 7, 255, 2**31 - 1, -(2**31), 2**40, -(2**40), 2**63 - 1, -(2**63))


def make_env(kind: str) -> NFVEnv:
    """A small environment with failures, full networks and a memory (``steps``), or one of NFVdeep (``nodes``)."""
    failures = {"p_fail_vm": 0.02, "p_fail_link": 0.02, "p_repair": 0.2}
    scenario = paper_scenario(
        6, horizon=20, arrival_rate=4.0, mean_lifetime=8.0, failures=failures, substrate={"vms_max": 2}
    )
    if kind == "nodes":
        return NFVdeepEnv(scenario, 3, stagger=True, segment=10)
    parts = [RequestObservation(), CandidateObservation(), MemoryObservation(4)]
    scenario = scenario.replace(colocation=True, admission_control=True)
    return NFVEnv(scenario, 3, observations=parts, stagger=True, segment=10)


def saved_state(kind: str, steps: int) -> dict:
    """The state of such an environment after some random steps."""
    env = make_env(kind)
    torch.manual_seed(steps)
    env.rollout(steps, break_when_any_done=False)
    return env.state_dict()


def mutate(state: dict, rng: random.Random) -> tuple[str, dict]:
    """What was damaged, and the state with that damage."""
    state = copy.deepcopy(state)
    places = [(state, key) for key in state] + [
        (part, key) for part in (state["world"], state.get("drafts", {})) for key in part
    ]
    group, key = rng.choice(places)
    how = rng.choice(("item", "item", "item", "field", "field", "other", "swap"))
    if how == "field":
        return _mutate_field(state, rng), state
    value = group[key]
    if how == "other" or not isinstance(value, torch.Tensor) or not value.numel():
        how = _replace(group, key, rng)
    elif how == "swap":
        flat = value.view(-1)
        one, other = rng.randrange(len(flat)), rng.randrange(len(flat))
        flat[one], flat[other] = flat[other].clone(), flat[one].clone()
    else:
        _set_item(value.view(-1), rng)
    return f"{key}: {how}", state


def _mutate_field(state: dict, rng: random.Random) -> str:
    records = state["world"]["env"].numpy().view(ENV_DTYPE).reshape(-1)
    name = rng.choice(ENV_DTYPE.names)
    record = rng.randrange(len(records))
    if ENV_DTYPE[name].kind == "f":
        records[name][record] = rng.choice((np.nan, np.inf, -np.inf, -1.0, 1e300))
    else:
        records[name][record] = rng.choice((*EXTREMES, int(records[name][record]) + rng.choice((-1, 1))))
    return f"env.{name}"


def _set_item(flat: torch.Tensor, rng: random.Random) -> None:
    place = rng.randrange(len(flat))
    if flat.dtype == torch.bool:
        flat[place] = ~flat[place]
    elif flat.is_floating_point():
        flat[place] = rng.choice((float("nan"), float("inf"), -1.0, 1e30))
    else:
        info = torch.iinfo(flat.dtype)
        flat[place] = min(max(rng.choice((*EXTREMES, rng.randrange(len(flat)))), info.min), info.max)


def _replace(group: dict, key: str, rng: random.Random) -> str:
    """Another value altogether, none, or one too many."""
    value = group[key]
    ways = ["missing", "extra", "text"]
    if isinstance(value, torch.Tensor):
        ways += ["dtype", "shape", "empty", "stride", "zeros"]
    elif isinstance(value, int):
        ways += ["negative", "huge", "float"]
    how = rng.choice(ways)
    group[key] = {
        "missing": lambda: value,
        "extra": lambda: value,
        "text": lambda: "text",
        "dtype": lambda: value.to(torch.float32 if value.dtype == torch.int64 else torch.int64),
        "shape": lambda: value[..., :-1].contiguous() if value.ndim else value[None],
        "empty": lambda: value[:0],
        "stride": lambda: torch.zeros(1, dtype=value.dtype).expand(len(value), 2**40),
        "zeros": lambda: torch.zeros_like(value),
        "negative": lambda: -1,
        "huge": lambda: 2**70,
        "float": lambda: 0.5,
    }[how]()
    if how == "missing":
        del group[key]
    elif how == "extra":
        group["extra"] = value
    return how


def play(kind: str, state: dict, steps: int = 50) -> None:
    """Load a state into a new environment and take random valid steps.

    Raises:
        CheckpointError: it was refused.
    """
    env = make_env(kind)
    env.load_state_dict(state)
    env.rollout(steps, break_when_any_done=False)


def main(count: int) -> None:
    outcomes: Counter[str] = Counter()
    for number in range(count):
        rng = random.Random(number)
        kind = rng.choice(("steps", "nodes"))
        what, damaged = mutate(saved_state(kind, rng.randrange(1, 60)), rng)
        print(number, kind, what, end=": ", flush=True)
        try:
            play(kind, damaged)
            answer = "harmless"
        except CheckpointError as error:
            answer = "refused"
            print(error, end=" ")
        outcomes[answer] += 1
        print(answer, flush=True)
    print(dict(outcomes))


if __name__ == "__main__":
    main(int(sys.argv[1]))
