"""Bounds that no method can exceed, on how many requests are accepted and on what they cost."""

from nfv_torchrl.bounds.bound import Bound, blind_bound, hindsight_bound, hindsight_least_cost, lifetime_luck

__all__ = ["Bound", "blind_bound", "hindsight_bound", "hindsight_least_cost", "lifetime_luck"]
