"""All settings of the pipeline in one pydantic model, each with a dotted key; a preset is a named set of settings."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
