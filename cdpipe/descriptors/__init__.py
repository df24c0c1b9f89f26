"""Place descriptors, learned and hand-made; besides `cdpipe.training` the only folder of cdpipe that uses torch."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
