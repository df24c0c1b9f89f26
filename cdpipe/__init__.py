"""Change detection between two LiDAR sessions of a tunnel; needs no simulator and no truth.

import cdpipe
report = cdpipe.detect("before", "after", preset="tunnelcd")
report.to_pandas("objects")
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
