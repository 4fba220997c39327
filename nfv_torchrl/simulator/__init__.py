"""How the world moves: compiled kernels over arrays of B networks."""

from nfv_torchrl.simulator.reasons import REASON_NAMES, Reason
from nfv_torchrl.simulator.simulator import Simulator, scenario_rules
from nfv_torchrl.simulator.state import OUTCOME, World
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE, Rules, Tables, build_tables

__all__ = [
    "DELAY_TOLERANCE",
    "OUTCOME",
    "REASON_NAMES",
    "Reason",
    "Rules",
    "Simulator",
    "Tables",
    "World",
    "build_tables",
    "scenario_rules",
]
