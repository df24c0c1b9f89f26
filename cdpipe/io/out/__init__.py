"""Sessions, maps and answers in formats that other people's tools open: bags, SemanticKITTI, poses, LAZ, PLY, Rerun."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
