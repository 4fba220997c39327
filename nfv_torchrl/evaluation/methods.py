"""The former place of ``nfv_torchrl.methods``, for scripts and settings that name it."""

from nfv_torchrl.methods import Method, PlannerMethod, PolicyMethod, RandomMethod, methods_from_config

__all__ = ["Method", "PlannerMethod", "PolicyMethod", "RandomMethod", "methods_from_config"]
