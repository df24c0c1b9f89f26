from .arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int8Array,
    Int32Array,
    Int64Array,
    require_shape,
    require_shapes,
)
from .grid_index import GridIndex
from .motion import Motion, make_motion
from .poses import (
    FARTHEST_M,
    fit_rigid,
    invert,
    make_pose,
    plane_jacobian,
    require_poses,
    transform,
    transform_each,
    travelled_m,
    yaw_pose,
    yaw_rad,
)
from .streams import stream
from .voxel import cell_keys, cell_means

__all__ = [
    "FARTHEST_M",
    "BoolArray",
    "Float32Array",
    "Float64Array",
    "GridIndex",
    "Int8Array",
    "Int32Array",
    "Int64Array",
    "Motion",
    "cell_keys",
    "cell_means",
    "fit_rigid",
    "invert",
    "make_motion",
    "make_pose",
    "plane_jacobian",
    "require_poses",
    "require_shape",
    "require_shapes",
    "stream",
    "transform",
    "transform_each",
    "travelled_m",
    "yaw_pose",
    "yaw_rad",
]
