"""``check_reward``: does a reward do what ``nfv_torchrl.rewards`` promises?"""

from __future__ import annotations

import numpy as np
import torch

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.rewards import CostScale, Reward
from nfv_torchrl.scenario import Scenario
from nfv_torchrl.testing.worlds import small_scenario

ENVS, STEPS = 4, 60


def check_reward(reward: Reward, *, scenario: Scenario | None = None, seed: int = 0) -> None:
    """Check a reward on what random valid actions bring in a small environment.

    - It returns one finite number for each environment, float64 [B], and not the same number for every step.
    - It writes into neither of its arguments.
    - The reward of an environment depends on that environment alone.

    Args:
        reward: called as ``reward(outcome, scale)``.
        scenario: where to try it; default six nodes.
        seed: of requests and actions.

    Raises:
        AssertionError: with what is wrong.
    """
    seen = []

    def watched(outcome, scale: CostScale) -> np.ndarray:
        given = {name: np.array(value) for name, value in outcome.items()}
        kept = {name: value.copy() for name, value in given.items()}
        values = np.asarray(reward(given, scale))
        changed = [name for name in kept if not np.array_equal(kept[name], given[name])]
        assert not changed, f"the reward writes into the outcome it is given ({', '.join(changed)})"
        assert values.shape == (ENVS,), f"the reward has shape {list(values.shape)}; return one number each, [{ENVS}]"
        assert np.isfinite(values).all(), f"the reward is {values[~np.isfinite(values)][0]} on ordinary data"
        for b in range(ENVS):
            alone = {name: value[b : b + 1] for name, value in kept.items()}
            single = np.asarray(reward(alone, CostScale(*(column[b : b + 1] for column in scale))))
            assert np.allclose(single, values[b : b + 1]), "the reward of an environment depends on the others"
        seen.append(values)
        return values

    env = NFVEnv(scenario or small_scenario(), ENVS, reward=watched, seed=seed)
    torch.manual_seed(seed)
    state = env.reset()
    for _ in range(STEPS):
        state["action"] = torch.multinomial(state["action_mask"].float(), 1).squeeze(-1)
        _, state = env.step_and_maybe_reset(state)
    assert np.ptp(np.concatenate(seen)) > 0, "the reward is the same for every step: nothing can be learned from it"
