"""Parts of the observation beside the flat observation and the mask. ``NFVEnv`` puts them together."""

from nfv_torchrl.observations.base import KnowingPart, ObservationPart, gather, read_observation
from nfv_torchrl.observations.candidates import CandidateObservation
from nfv_torchrl.observations.graph import GraphObservation
from nfv_torchrl.observations.lookahead import LookaheadObservation
from nfv_torchrl.observations.memory import MemoryObservation
from nfv_torchrl.observations.outcome import outcome_spec, read_outcome
from nfv_torchrl.observations.request import RequestObservation

__all__ = [
    "CandidateObservation",
    "GraphObservation",
    "KnowingPart",
    "LookaheadObservation",
    "MemoryObservation",
    "ObservationPart",
    "RequestObservation",
    "gather",
    "outcome_spec",
    "read_observation",
    "read_outcome",
]
