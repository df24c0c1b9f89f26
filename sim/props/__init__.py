"""Props, the objects that may change: boxes, chairs, vehicles, rocks, muck piles, meshes from files; see HOWTO.md."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
