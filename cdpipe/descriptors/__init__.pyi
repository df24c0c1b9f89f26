from .describe import (
    checkpoint_digest,
    describe_scan,
    describe_scans,
    list_checkpoints,
    load_descriptors,
    save_descriptors,
    use_threads,
)
from .point_changes import change_probabilities, range_net_digest
from .sphere import anchor_frames, describe_map, sphere_digest
from .yaw import relative_yaws_rad

__all__ = [
    "anchor_frames",
    "change_probabilities",
    "checkpoint_digest",
    "describe_map",
    "describe_scan",
    "describe_scans",
    "list_checkpoints",
    "load_descriptors",
    "range_net_digest",
    "relative_yaws_rad",
    "save_descriptors",
    "sphere_digest",
    "use_threads",
]
