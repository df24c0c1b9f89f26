from .measure import measure_surface
from .unrolled import middle_place, unroll

__all__ = ["measure_surface", "middle_place", "unroll"]
