"""Tracing: the centrelines, on the floor, of a mesh that somebody else made, and a scenario along them.

Shafts and raises, through which one can only fly, are left out; a note says where.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
