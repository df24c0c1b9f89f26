"""Placement of props: on the floor, clear of rock and of each other, settled by physics, with a lane for robots."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
