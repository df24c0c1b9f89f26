"""Rock of a recording that moves: where it can, its surface as recorded and as moved, and the returns on it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
