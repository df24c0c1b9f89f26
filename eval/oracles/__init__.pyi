from .merge import OracleMerge, merged_by_truth
from .regions import regions_by_truth

__all__ = [
    "OracleMerge",
    "merged_by_truth",
    "regions_by_truth",
]
