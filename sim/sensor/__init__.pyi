from .lidar import FALSE_RETURN, Scan, scan
from .rays import Rays, revolution_rays

__all__ = [
    "FALSE_RETURN",
    "Rays",
    "Scan",
    "revolution_rays",
    "scan",
]
