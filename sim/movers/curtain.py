"""A ventilation curtain: level strips of plastic sheet, each hung from the one above, that swing in the draught."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array
from sim.movers.body import Body, Link, Moment, pitch_poses
from sim.props.parts import block

_STRIPS = 6
_THICK_M = 0.012
_LAG_RAD = 0.35  # by which each strip follows the one above; ours, unverified
_GRAVITY_MPS2 = 9.81


class Curtain(Body):
    """A curtain of some width that hangs from its root down to `-height_m` when it is still."""

    def __init__(self, width_m: float, height_m: float, swing_deg: float) -> None:
        self.strip_m = height_m / _STRIPS
        self.swing_rad = np.deg2rad(swing_deg)
        # period of a uniform rod of this length about its end: 2 pi sqrt(2 L / 3 g)
        self.period = (1.0, float(2.0 * np.pi * np.sqrt(2.0 * height_m / (3.0 * _GRAVITY_MPS2))))
        low, high = (-_THICK_M / 2, -width_m / 2, -self.strip_m), (_THICK_M / 2, width_m / 2, 0.0)
        self.links = tuple(Link(f"strip {number}", (block(low, high, "plastic"),)) for number in range(_STRIPS))

    def place_links(self, moment: Moment) -> Float64Array:
        """Return root_T_link (6, T, 4, 4), from the top down; the lowest strip swings by `swing_deg`."""
        x, z = np.zeros_like(moment.time_s), np.zeros_like(moment.time_s)
        poses = []
        for number in range(_STRIPS):
            phase = 2.0 * np.pi * moment.time_s / self.period[1] - number * _LAG_RAD
            angle = self.swing_rad * (number + 1) / _STRIPS * np.sin(phase)
            poses.append(pitch_poses(angle, x, 0.0, z))
            x, z = x - self.strip_m * np.sin(angle), z - self.strip_m * np.cos(angle)
        return np.stack(poses)
