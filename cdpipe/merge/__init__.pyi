from .merge import merge_maps

__all__ = [
    "merge_maps",
]
