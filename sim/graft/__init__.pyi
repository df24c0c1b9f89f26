from .pair import graft_in_memory, graft_pair
from .plan import ONE_RECORDING, Recorded
from .splitting import split_scans

__all__ = [
    "ONE_RECORDING",
    "Recorded",
    "graft_in_memory",
    "graft_pair",
    "split_scans",
]
