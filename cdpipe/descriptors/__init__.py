"""Descriptors of places, learned and hand-made; with `cdpipe.training` the only part of cdpipe that needs torch."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
