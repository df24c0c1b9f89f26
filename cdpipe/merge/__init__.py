"""Putting both maps into one frame, with evidence, or refusing to."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
