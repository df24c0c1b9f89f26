"""Where vehicles have raised dust up to a moment of a session."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpipe.core.geometry import Float64Array
from sim.movers.mover import MovingBody
from sim.sensor.plumes import LIFE_S, Puffs

_STEP_S = 0.5


def raise_dust(movers: Sequence[MovingBody], time_s: float) -> Puffs | None:
    """Return the puffs that the movers of a session have raised by a time; None if none of them raises any.

    Their course goes on before the session begins, so the air is dusty at its start.
    """
    raised: list[Float64Array] = []
    mass_mg: list[Float64Array] = []
    age_s: list[Float64Array] = []
    times = time_s - np.arange(0.0, LIFE_S + _STEP_S, _STEP_S)
    for body in movers:
        if not body.mover.dust_mg_per_m:
            continue
        places = body.world_T_root(times)[:, :3, 3]
        moved_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
        goes = moved_m > 0
        raised.append(((places[1:] + places[:-1]) / 2)[goes])
        age_s.append(time_s - ((times[1:] + times[:-1]) / 2)[goes])
        mass_mg.append(body.mover.dust_mg_per_m * moved_m[goes])
    if not raised:
        return None
    return Puffs(np.concatenate(raised), np.concatenate(age_s), np.concatenate(mass_mg))
