from .bench import BenchSite, sensor_contests
from .timing import Contest, timed

__all__ = [
    "BenchSite",
    "Contest",
    "sensor_contests",
    "timed",
]
