"""Evolution strategies: whole horizons as fitness, played in the compiled simulator."""

from nfv_torchrl.evolution.strategy import Strategy
from nfv_torchrl.evolution.tasks import FixedNetwork, RandomNetworks, Redrawn, Task
from nfv_torchrl.methods.evolved import CandidatePolicy, PricePolicy

__all__ = ["CandidatePolicy", "FixedNetwork", "PricePolicy", "RandomNetworks", "Redrawn", "Strategy", "Task"]
