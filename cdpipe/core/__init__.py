"""Core: errors, geometry, files, isolated processes, plug-ins and progress; every other folder may use it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
