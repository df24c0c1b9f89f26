from .errors import InputError, MergeFailedError, ScenarioError, TunnelcdError
from .geometry import (
    GridIndex,
    Motion,
    cell_keys,
    cell_means,
    invert,
    make_motion,
    make_pose,
    stream,
    transform,
    yaw_pose,
)
from .ranking import auroc, average_precision
from .yamlfile import Document, Settings, read_yaml, validate

__all__ = [
    "Document",
    "GridIndex",
    "InputError",
    "MergeFailedError",
    "Motion",
    "ScenarioError",
    "Settings",
    "TunnelcdError",
    "auroc",
    "average_precision",
    "cell_keys",
    "cell_means",
    "invert",
    "make_motion",
    "make_pose",
    "read_yaml",
    "stream",
    "transform",
    "validate",
    "yaw_pose",
]
