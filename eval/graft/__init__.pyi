from .making import fill_pair, make_afters, make_pair

__all__ = [
    "fill_pair",
    "make_afters",
    "make_pair",
]
