"""How planner kernels are compiled: as those of the simulator, see there."""

from nfv_torchrl.simulator.compiled import inlined, kernel, part

__all__ = ["inlined", "kernel", "part"]
