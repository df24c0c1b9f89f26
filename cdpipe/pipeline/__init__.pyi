from .detection import Merge, Propose, detect, detect_changes, detect_merge, merge_mapped, require_usable
from .hooks import Done, Hooks, Stage, T
from .mapping import describe, map_pair, map_session, map_sources

__all__ = [
    "Done",
    "Hooks",
    "Merge",
    "Propose",
    "Stage",
    "T",
    "describe",
    "detect",
    "detect_changes",
    "detect_merge",
    "map_pair",
    "map_session",
    "map_sources",
    "merge_mapped",
    "require_usable",
]
