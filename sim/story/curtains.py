"""Curtains hang in one place in all sessions of a world: one that hung elsewhere would be a change."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from sim.movers.mover import MovingBody


def refuse_moved_curtains(session: str, movers: Iterable[MovingBody], curtains: dict[str, Float64Array]) -> None:
    """Note where the curtains of a session hang.

    Args:
        session: Its name, for messages.
        movers: What moves in it.
        curtains: Place of each curtain in earlier sessions, by name; those of this session are added.

    Raises:
        ScenarioError: One hangs elsewhere than in an earlier session.
    """
    for body in movers:
        if body.mover.kind != "curtain":
            continue
        place = curtains.setdefault(body.mover.name, body.course.points[0])
        if not np.array_equal(place, body.course.points[0]):
            raise ScenarioError(
                f"{session}: mover {body.mover.name!r}: the curtain finds no way where it hung before, and a curtain "
                "that hangs elsewhere is a change: give its path between, fractions and lateral"
            )
