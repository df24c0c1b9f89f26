from .archive import unpack_release
from .content import load_release, release_names
from .making import make_release

__all__ = [
    "load_release",
    "make_release",
    "release_names",
    "unpack_release",
]
