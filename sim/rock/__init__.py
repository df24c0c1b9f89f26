"""The rock: centrelines, cross-sections, floor and roughness of drifts, their wall mesh, and foreign meshes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
