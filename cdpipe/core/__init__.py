"""Core: errors, poses, motion, voxel grid, grid index, plug-ins and the YAML reader; every other folder may use it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
