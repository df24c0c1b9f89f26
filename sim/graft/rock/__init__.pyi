from .finding import find_rock
from .moving import RockCounts, RockTruth, move_rock
from .patch import Patch

__all__ = ["Patch", "RockCounts", "RockTruth", "find_rock", "move_rock"]
