"""What every part of the evaluation uses: output folders, progress, provenance, statistics, workers, figures, exits."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
