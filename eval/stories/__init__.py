"""Reports about a story: session 1 compared with every later one, and what became of each place and prop."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
