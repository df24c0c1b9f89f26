"""Plans: which worlds, seeds and variants a run holds; the shipped plans are the YAML files here."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
