from .describe import (
    checkpoint_digest,
    describe_scan,
    describe_scans,
    list_checkpoints,
    load_descriptors,
    save_descriptors,
    use_threads,
)
from .sphere import anchor_frames, describe_map, sphere_digest
from .yaw import relative_yaws_rad

__all__ = [
    "anchor_frames",
    "checkpoint_digest",
    "describe_map",
    "describe_scan",
    "describe_scans",
    "list_checkpoints",
    "load_descriptors",
    "relative_yaws_rad",
    "save_descriptors",
    "sphere_digest",
    "use_threads",
]
