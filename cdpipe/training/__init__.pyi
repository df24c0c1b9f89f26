from .change_training import ChangeTask
from .data import ChangePairs, TunnelShard, open_dataset, read_place_data, stacked
from .fit import FitConfig
from .scan_training import PlaceTask
from .shard import read_shard
from .sphere_training import SphereTask, read_sphere_data

__all__ = [
    "ChangePairs",
    "ChangeTask",
    "FitConfig",
    "PlaceTask",
    "SphereTask",
    "TunnelShard",
    "open_dataset",
    "read_place_data",
    "read_shard",
    "read_sphere_data",
    "stacked",
]
