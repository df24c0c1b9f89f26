"""Mapping: from the scans of one session to a voxel map with keyframes and their free space."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
