from .body import Body, Link, Moment
from .casting import MovingCaster, MovingScene
from .course import Course
from .kinds import build_body
from .mover import MovingBody
from .planning import plan_movers

__all__ = [
    "Body",
    "Course",
    "Link",
    "Moment",
    "MovingBody",
    "MovingCaster",
    "MovingScene",
    "build_body",
    "plan_movers",
]
