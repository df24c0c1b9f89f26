from .making import make_afters, make_pair

__all__ = [
    "make_afters",
    "make_pair",
]
