"""Props cast into the scans of real recordings: pairs with exact truth on real noise."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
