from .query import find_regions, rank_regions

__all__ = [
    "find_regions",
    "rank_regions",
]
