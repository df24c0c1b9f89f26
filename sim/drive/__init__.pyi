from .odometry import register_scans, start_pose
from .trajectory import Trajectory, plan_trajectory, record

__all__ = [
    "Trajectory",
    "plan_trajectory",
    "record",
    "register_scans",
    "start_pose",
]
