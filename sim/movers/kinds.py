"""The body of each kind of mover."""

from __future__ import annotations

from scenarios.schema import Mover
from sim.movers.body import Body
from sim.movers.curtain import Curtain
from sim.movers.machines import Forklift, Loader
from sim.movers.person import Person


def build_body(mover: Mover, hang_m: float = 2.0) -> Body:
    """Return the body of a mover.

    Args:
        mover: The mover; its keys are those of its kind.
        hang_m: How far a curtain hangs down, metres; no other kind needs it.
    """
    if mover.kind == "person":
        assert mover.height_m is not None and mover.speed_mps is not None
        return Person(mover.height_m, mover.speed_mps)
    if mover.kind == "curtain":
        assert mover.width_m is not None and mover.swing_deg is not None
        return Curtain(mover.width_m, hang_m, mover.swing_deg)
    assert mover.size_m is not None
    return Forklift(mover.size_m) if mover.kind == "forklift" else Loader(mover.size_m)
