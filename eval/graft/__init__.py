"""Recordings as worlds of pairs: opened, merged, and handed to `sim.graft`; and where recordings of others are."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
