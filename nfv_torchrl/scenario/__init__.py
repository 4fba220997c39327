"""What the world is: substrate, services, workload, failures; frozen data with generators, readers and writers.

Needs NumPy and networkx, not torch. Start at ``Scenario``.
"""

from nfv_torchrl.scenario.config import ScenarioConfig, SubstrateConfig
from nfv_torchrl.scenario.failures import FailureModel, FailureTimeline, sample_timeline
from nfv_torchrl.scenario.files import StoredRun, read_run_folder, scenario_to_json
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.resources import ResourceRanges
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType, paper_catalogue
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.topology_zoo import read_topology, shipped_topologies
from nfv_torchrl.scenario.waxman import draw_waxman
from nfv_torchrl.scenario.workload import Workload, draw_chains

__all__ = [
    "FailureModel",
    "FailureTimeline",
    "ResourceRanges",
    "Scenario",
    "ScenarioConfig",
    "ServiceCatalogue",
    "ServiceType",
    "StoredRun",
    "Stream",
    "Substrate",
    "SubstrateConfig",
    "Workload",
    "draw_chains",
    "draw_random_substrate",
    "draw_waxman",
    "generator",
    "paper_catalogue",
    "paper_scenario",
    "read_run_folder",
    "read_topology",
    "sample_timeline",
    "scenario_to_json",
    "shipped_topologies",
]
