"""Tunnel worlds, drives through them, and LiDAR sessions with their truth.

`simulate` writes a pair of sessions, `build_world` returns the world alone, `simulate_in_memory` keeps the pair in
memory, `read_pair_truth` and `read_labels` read the truth of a pair on disk. Nothing heavy is loaded before it is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
