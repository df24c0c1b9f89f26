from .answer_map import gather_answer_map, require_own_keyframes
from .bags import write_bag
from .clouds import write_laz, write_ply
from .kitti import Label, write_kitti
from .maps import PointMap, gather_map
from .poses import write_kitti_poses, write_tum_poses
from .rerun import write_rrd
from .scans import Fields, Outgoing, OutScan

__all__ = [
    "Fields",
    "Label",
    "OutScan",
    "Outgoing",
    "PointMap",
    "gather_answer_map",
    "gather_map",
    "require_own_keyframes",
    "write_bag",
    "write_kitti",
    "write_kitti_poses",
    "write_laz",
    "write_ply",
    "write_rrd",
    "write_tum_poses",
]
