from .adapters import held_input, pipeline_input
from .ground_truth import GroundTruth, SessionTruth, load_ground_truth
from .scoring_points import ScoringPoints, load_scoring_points

__all__ = [
    "GroundTruth",
    "ScoringPoints",
    "SessionTruth",
    "held_input",
    "load_ground_truth",
    "load_scoring_points",
    "pipeline_input",
]
