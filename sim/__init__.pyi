from .scene import Scene, World, build_world
from .session.simulate import simulate, simulate_in_memory
from .session.truth import Change, PairTruth, read_labels, read_pair_truth, read_true_poses

__all__ = [
    "Change",
    "PairTruth",
    "Scene",
    "World",
    "build_world",
    "read_labels",
    "read_pair_truth",
    "read_true_poses",
    "simulate",
    "simulate_in_memory",
]
