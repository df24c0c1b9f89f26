"""Rock that moves between the sessions: the walls of both, on one topology, and the exact displacement between them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
