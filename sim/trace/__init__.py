"""Tracing: the drivable or flyable centreline of a mesh that somebody else made, and a scenario along it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
