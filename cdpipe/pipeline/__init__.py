"""The pipeline: map, describe, merge, query, extract. This folder alone defines the order of the stages.

`detect` takes two sessions, `detect_changes` two mapped sessions. `Hooks` are called around every stage: the command
line reports progress with them, a benchmark caches and times results. `regions.source` names what finds the regions
in the merged maps.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
