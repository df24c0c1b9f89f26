"""The truth that a pair is scored against, and the only place where a simulated session becomes input of a method."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
