from .errors import InputError, MergeFailedError, ScenarioError, TunnelcdError
from .geometry import invert, make_pose, stream, transform, yaw_pose
from .grid_index import GridIndex
from .motion import Motion, make_motion
from .ranking import auroc, average_precision
from .voxel import cell_keys, cell_means
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
