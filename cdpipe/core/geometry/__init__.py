"""Poses, motion, frames by path and gravity, voxels, the grid index, types of arrays and seeded random generators.

A pose `dst_T_src` is a (4, 4) float64 rigid transform: `p_dst = dst_T_src @ p_src`. x is forward, z up, right-handed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
