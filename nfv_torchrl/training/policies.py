"""The former place of the policy files of ``nfv_torchrl.methods``, for scripts and settings that name it."""

from nfv_torchrl.methods import load_policy, load_weights, policy_content, save_policy

__all__ = ["load_policy", "load_weights", "policy_content", "save_policy"]
