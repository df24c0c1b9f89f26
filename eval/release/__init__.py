"""Data that are handed out: releases of simulated pairs in one file, digests of files, and Croissant metadata."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
