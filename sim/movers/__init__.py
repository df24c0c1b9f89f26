"""What moves while a session is recorded: people, machines and curtains, posed at the time of every column."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
