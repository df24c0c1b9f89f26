"""Plans, scores and reports; write `from eval import score`, never `import eval`, which shadows the builtin."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
