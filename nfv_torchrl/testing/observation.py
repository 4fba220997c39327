"""``check_observation``: does a part of the observation do what ``ObservationPart`` promises?"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import check_env_specs

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.observations import ObservationPart
from nfv_torchrl.scenario import Scenario
from nfv_torchrl.testing.worlds import small_scenario

STEPS = 40


def check_observation(make: Callable[[], ObservationPart], *, scenario: Scenario | None = None, seed: int = 0) -> None:
    """Check a part of the observation in a small environment, alone and in a batch, over some forty steps.

    - ``read`` returns the keys of ``specs`` with their shapes and dtypes, all finite, and fits TorchRL's own check.
    - What it gave away stays: later steps write into the simulator's arrays, not into earlier observations.
    - To read is all it does: it writes nothing into the simulator, and reading twice gives the same twice.
    - Environment b is seen alike in a batch and by itself.

    Args:
        make: the class, or a function that makes a part.
        scenario: where to try it; default six nodes.
        seed: of requests and actions.

    Raises:
        AssertionError: with what is wrong.
    """
    scenario = scenario or small_scenario()
    batch = _watch(NFVEnv(scenario, 3, observations=[make()], seed=seed), seed)
    alone = _watch(NFVEnv(scenario, 1, observations=[make()], seed=seed), seed, follow=batch)
    for step, (several, single) in enumerate(zip(batch, alone, strict=True)):
        for key in single.keys(True, True):
            if key != "action":
                assert torch.equal(several[key][:1], single[key]), f"{key}: other numbers in a batch, at step {step}"
    check_env_specs(NFVEnv(scenario, 2, observations=[make()], seed=seed))


def _watch(env: NFVEnv, seed: int, follow: list[TensorDictBase] | None = None) -> list[TensorDictBase]:
    """What the part shows in every step, with the action that was taken; ``follow`` says which."""
    part = env.parts[0]
    specs = part.specs(env.simulator)
    _check_specs(TensorDict(part.read(env.simulator), batch_size=env.batch_size), specs)
    torch.manual_seed(seed)
    state = env.reset()
    given, shown = [], []
    for step in range(STEPS):
        before = {name: value.clone() for name, value in env.state_dict()["world"].items()}
        first, second = (TensorDict(part.read(env.simulator), batch_size=env.batch_size) for _ in range(2))
        _check_specs(first, specs)
        for key in first.keys(True, True):
            assert torch.equal(first[key], second[key]), f"{key}: read twice in a row, it differs"
        after = env.state_dict()["world"]
        changed = [name for name in before if not torch.equal(before[name], after[name])]
        assert not changed, f"read writes into the simulator ({', '.join(changed)})"
        given.append(first)
        if follow is None:
            action = torch.multinomial(state["action_mask"].float(), 1).squeeze(-1)
        else:
            action = follow[step]["action"][: env.batch_size[0]]
        shown.append(first.clone().set("action", action))
        _, state = env.step_and_maybe_reset(state.set("action", action))
    for step, (then, now) in enumerate(zip(shown, given, strict=True)):
        for key in now.keys(True, True):
            kept = torch.equal(then[key], now[key])
            assert kept, f"{key}: the tensor given away at step {step} was written into later; return a copy"
    return shown


def _check_specs(values: TensorDictBase, specs: dict) -> None:
    assert set(values.keys()) == set(specs), f"read returns {sorted(values.keys())}, specs say {sorted(specs)}"
    for name, spec in specs.items():
        value = values[name]
        fits = value.shape == spec.shape and spec.is_in(value)
        assert fits, f"{name}: shape {list(value.shape)}, dtype or range is not that of its spec, {list(spec.shape)}"
        leaves = value.values(True, True) if isinstance(value, TensorDictBase) else [value]
        for leaf in leaves:
            assert not leaf.is_floating_point() or torch.isfinite(leaf).all(), f"{name}: a number is not finite"
