"""Learned descriptors of places; the only part of cdpipe that needs torch."""

from cdpipe.descriptor.describe import (
    checkpoint_digest,
    describe_scan,
    describe_scans,
    load_descriptors,
    save_descriptors,
    use_threads,
)
from cdpipe.descriptor.network import relative_yaws_rad
from cdpipe.descriptor.sphere import describe_map, sphere_digest

__all__ = [
    "checkpoint_digest",
    "describe_map",
    "describe_scan",
    "describe_scans",
    "load_descriptors",
    "relative_yaws_rad",
    "save_descriptors",
    "sphere_digest",
    "use_threads",
]
