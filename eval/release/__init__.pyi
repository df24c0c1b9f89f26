from .archive import unpack_release
from .content import load_release
from .making import make_release
from .names import release_names

__all__ = [
    "load_release",
    "make_release",
    "release_names",
    "unpack_release",
]
