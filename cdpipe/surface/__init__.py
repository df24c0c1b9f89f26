"""How far the rock moved between two merged sessions: signed displacement of the surface, with a level of detection."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
