from .free_space import free_space_votes, grazing_ray_count
from .mapping import build_map, choose_keyframes
from .poses.odometry import estimate_motion
from .session_check import check_session

__all__ = [
    "build_map",
    "check_session",
    "choose_keyframes",
    "estimate_motion",
    "free_space_votes",
    "grazing_ray_count",
]
