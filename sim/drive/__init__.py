"""Drives: the path of a robot, its movement over the floor, its odometry, and the poses of every revolution."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
