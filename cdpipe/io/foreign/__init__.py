"""Recordings of other people's formats: scans, whole maps, trajectories and bags, guessed from their content."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
