from .pairs import PairMaker
from .simulate import simulate_story
from .state import SessionState, Story, is_story, read_story

__all__ = [
    "PairMaker",
    "SessionState",
    "Story",
    "is_story",
    "read_story",
    "simulate_story",
]
