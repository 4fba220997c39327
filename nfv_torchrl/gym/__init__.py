"""Environments for Gymnasium, for libraries such as MaskablePPO of sb3-contrib that know nothing of TorchRL.

``import nfv_torchrl.gym`` registers ``nfv_torchrl/NFV-v0``::

    env = gymnasium.make("nfv_torchrl/NFV-v0", scenario={"substrate": {"nodes": 20}}, seed=1)
    envs = gymnasium.make_vec("nfv_torchrl/NFV-v0", num_envs=64)  # one simulator for all
    env.action_masks(), envs.action_masks()  # bool [A], bool [64, A]

They are classes of their own over the simulator rather than ``NFVEnv`` through ``EnvBase.register_gym``: maskable
agents call ``action_masks()`` on the environment, which a registered TorchRL environment does not have, and they need
none of the tensors in between. ``make`` puts no wrapper around the environment, since Gymnasium's wrappers hide
``action_masks()``. Its checker is ``gymnasium.make(..., disable_env_checker=False)`` or ``check_env(env)``.

For Stable-Baselines3: ``nfv_torchrl.gym.sb3``. For TorchRL's ``GymWrapper``: ``wrap_for_torchrl``.
"""

import gymnasium

from nfv_torchrl.gym.single import NFVGymEnv
from nfv_torchrl.gym.vector import NFVVectorEnv
from nfv_torchrl.gym.wrapping import wrap_for_torchrl

ENV_ID = "nfv_torchrl/NFV-v0"

__all__ = ["ENV_ID", "NFVGymEnv", "NFVVectorEnv", "wrap_for_torchrl"]

gymnasium.register(
    id=ENV_ID,
    entry_point="nfv_torchrl.gym:NFVGymEnv",
    vector_entry_point="nfv_torchrl.gym:NFVVectorEnv",
    # Both only wrap the environment, and so hide its own methods. It checks the order of calls itself.
    order_enforce=False,
    disable_env_checker=True,
)
