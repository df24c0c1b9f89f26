from .measure import measure_surface
from .unrolled import unroll

__all__ = ["measure_surface", "unroll"]
