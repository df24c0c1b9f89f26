from .reality import compare
from .sensor_measures import Revolutions

__all__ = [
    "Revolutions",
    "compare",
]
