"""What a scenario is, once its seed has drawn every distribution. Lengths in metres, angles in degrees.

Frame: `world`, x forward, z up. A drift follows the polyline of its nodes; node z is floor level. Left and right of
furniture and niches are those of a drift's own direction, from its first node to its last; of a place those of the way
from the first to the second node of `between` (drawn places: as driven); of a session those of its drive.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
