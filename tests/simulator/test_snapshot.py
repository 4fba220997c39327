"""A stranger's snapshot: refused by name, or harmless, and never a crash of compiled code."""

import copy
import random

import mutations
import numpy as np
import pytest
import torch

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.simulator.state import ENV_DTYPE


@pytest.fixture(scope="module", params=["steps", "nodes"])
def saved(request):
    return request.param, mutations.saved_state(request.param, 33)


def env_fields(state: dict) -> np.ndarray:
    """The records of the environments in a state, to write to."""
    return state["world"]["env"].numpy().view(ENV_DTYPE).reshape(-1)


@pytest.mark.parametrize("number", range(40))
def test_damage_is_refused_or_harmless(saved, number):
    kind, state = saved
    _, damaged = mutations.mutate(state, random.Random(number))
    try:
        mutations.play(kind, damaged, 20)
    except CheckpointError as error:
        assert str(error).startswith(("checkpoint: ", "snapshot: ", "the checkpoint holds"))


@pytest.mark.parametrize("name", [name for name in ENV_DTYPE.names if ENV_DTYPE[name].kind == "i"])
@pytest.mark.parametrize("value", [-(2**40), 2**40])
def test_no_number_of_an_environment_is_taken_on_trust(saved, name, value):
    kind, state = saved
    damaged = copy.deepcopy(state)
    env_fields(damaged)[name][1] = value
    with pytest.raises(CheckpointError, match=rf"snapshot: env\.{name} of environment 1 "):
        mutations.make_env(kind).load_state_dict(damaged)


def cycle_of_free_records(state: dict) -> None:
    first = env_fields(state)["free_record"][0]
    state["world"]["running.record_next"][0, first] = int(first)


def free_record_in_a_slot(state: dict) -> None:
    state["world"]["running.head"][0, -1] = int(env_fields(state)["free_record"][0])


def shared_reservations(state: dict) -> None:
    running = env_fields(state)["num_running"]
    env = int(np.argmax(running))
    heads = state["world"]["running.head"][env]
    record = int(heads[heads >= 0][0])
    state["world"]["running.record_entry"][env, record] = int(env_fields(state)["free_entry"][env])


def departed_long_ago(state: dict) -> None:
    heads = state["world"]["running.head"]
    env, slot = (int(index) for index in np.argwhere(heads.numpy() >= 0)[0])
    heads[env, 0], heads[env, slot] = heads[env, slot].clone(), -1


def teleport(state: dict) -> None:
    state["world"]["seen.mask"][0] = True


def another_function(state: dict) -> None:
    state["world"]["running.entry_use"] += 1


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (cycle_of_free_records, "running.record_next of environment 0 has a cycle"),
        (free_record_in_a_slot, "running.record_next of environment 0 has a cycle, or two chains that meet"),
        (shared_reservations, "running.entry_next of environment . has a cycle, or two chains that meet"),
        (departed_long_ago, "running.head of environment . holds what has left"),
        (teleport, "seen.mask of environment 0 is not what is possible"),
        (another_function, "is no function or segment of its request|is not what walks and running requests hold"),
    ],
)
def test_chains_masks_and_books(saved, damage, named):
    kind, state = saved
    damaged = copy.deepcopy(state)
    damage(damaged)
    with pytest.raises(CheckpointError, match=named):
        mutations.make_env(kind).load_state_dict(damaged)


def test_a_refused_state_leaves_the_environment_as_it_was(saved):
    kind, state = saved
    env, other = mutations.make_env(kind), mutations.make_env(kind)
    for one in (env, other):
        torch.manual_seed(1)
        one.rollout(7, break_when_any_done=False)
    # The last thing that is checked is wrong, when everything else has been read.
    damaged = copy.deepcopy(state)
    if kind == "nodes":
        damaged["drafts"]["state"][0] = 2
    else:
        damaged["memories"][0]["memory"][0, 0] = float("nan")
    with pytest.raises(CheckpointError):
        env.load_state_dict(damaged)
    here, there = env.state_dict(), other.state_dict()
    for name, array in here.pop("world").items():
        assert torch.equal(array, there["world"][name]), name
    assert str(here) == str({key: value for key, value in there.items() if key != "world"})


def test_a_sound_state_is_taken(saved):
    kind, state = saved
    mutations.play(kind, state)
