"""The course of a mover: to and fro along a line on the floor, with a pause at either end, at any time of a session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float64Array, make_pose
from sim.movers.body import Moment

# Ours, unverified: over this distance before and after a stop the steps of who walks grow or shrink; and the sway of a
# body that stands, an inverted pendulum about its feet.
_STOPPING_M = 0.7
_SWAY_S = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A line that a body follows to and fro, and when.

    Attributes:
        distance_m: (N,) distance along the line from its start; N is 1 for a body that stays.
        points: (N, 3) on the floor, world frame; of a curtain, the middle of its upper edge.
        yaw_rad, pitch_rad, roll_rad: (N,) attitude of a body that faces along the line.
        slope: (N,) rise of the floor per metre along the line, of a body that is not pitched with it.
        bend_per_m: (N,) curvature, to the left positive.
        speed_mps: Speed between the pauses.
        pause_s: Time at either end.
        offset_s: Time since the body left the start, at time 0 of the session.
        is_turning: Whether the body turns round at either end; else it comes back backwards.
        sway_rad: Amplitude of its sway to the sides while it stands.
    """

    distance_m: Float64Array
    points: Float64Array
    yaw_rad: Float64Array
    pitch_rad: Float64Array
    roll_rad: Float64Array
    slope: Float64Array
    bend_per_m: Float64Array
    speed_mps: float
    pause_s: float
    offset_s: float
    is_turning: bool
    sway_rad: float = 0.0

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(self.distance_m[-1])

    @property
    def is_moving(self) -> bool:
        """Whether the body ever leaves its place."""
        return self.length_m > 0 and self.speed_mps > 0

    @property
    def period_s(self) -> float:
        """Time there and back with both pauses, that of a sway for a body that stays."""
        return 2.0 * (self.length_m / self.speed_mps + self.pause_s) if self.is_moving else _SWAY_S

    def find_place(self, time_s: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the distance along the line (T,) and `turned` (T,) of `Moment` at times (T,)."""
        if not self.is_moving:
            return np.zeros_like(time_s), np.zeros_like(time_s)
        phase_s = (time_s + self.offset_s) % self.period_s
        go_s, pause_s = self.length_m / self.speed_mps, max(self.pause_s, 1e-9)
        half_s = go_s + self.pause_s
        is_back = phase_s >= half_s
        in_half_s = np.where(is_back, phase_s - half_s, phase_s)
        gone_m = np.minimum(self.speed_mps * in_half_s, self.length_m)
        share = np.clip((in_half_s - go_s) / pause_s, 0.0, 1.0)
        eased = share * share * (3.0 - 2.0 * share)
        return np.where(is_back, self.length_m - gone_m, gone_m), np.where(is_back, 1.0 - eased, eased)

    def pass_times(self, step_m: float) -> Float64Array:
        """Return times (T,) since it left the start at which it is at places every `step_m` or less, out and back."""
        n_steps = max(1, int(np.ceil(self.length_m / step_m)))
        out_s = np.linspace(0.0, self.length_m / self.speed_mps, n_steps + 1)
        return np.concatenate([out_s, self.period_s / 2 + out_s])

    def moment(self, time_s: Float64Array) -> Moment:
        """Return what the body does at times (T,)."""
        along_m, turned = self.find_place(time_s)
        way_m = np.where(turned < 0.5, along_m, self.length_m - along_m)
        to_stop_m = np.minimum(along_m, self.length_m - along_m)
        share = np.clip(to_stop_m / min(_STOPPING_M, max(self.length_m / 2, 1e-9)), 0.0, 1.0)
        ahead = 1.0 - 2.0 * turned if self.is_turning else np.ones_like(turned)
        return Moment(
            time_s=time_s + self.offset_s,
            way_m=way_m,
            activity=share * share * (3.0 - 2.0 * share),
            turned=turned,
            slope=ahead * np.interp(along_m, self.distance_m, self.slope),
            bend_per_m=np.interp(along_m, self.distance_m, self.bend_per_m),
        )

    def world_T_root(self, time_s: Float64Array) -> Float64Array:
        """Return the pose (T, 4, 4) of the root at times (T,)."""
        along_m, turned = self.find_place(time_s)
        figures = (*self.points.T, self.yaw_rad, self.pitch_rad, self.roll_rad)
        x, y, z, yaw, pitch, roll = (np.interp(along_m, self.distance_m, values) for values in figures)
        if self.is_turning:
            yaw = yaw + np.pi * turned
        if not self.is_moving:
            roll = roll + self.sway_rad * np.sin(2.0 * np.pi * (time_s + self.offset_s) / _SWAY_S)
        return make_pose(_turns(yaw, pitch, roll), np.stack([x, y, z], axis=-1))


def _turns(yaw: Float64Array, pitch: Float64Array, roll: Float64Array) -> Float64Array:
    """Return the rotations (T, 3, 3) about z, then y, then x, as "ZYX" of scipy's Rotation."""
    (cz, cy, cx), (sz, sy, sx) = (tuple(of(angle) for angle in (yaw, pitch, roll)) for of in (np.cos, np.sin))
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def stay(point: Float64Array, yaw_rad: float, offset_s: float, sway_rad: float = 0.0) -> Course:
    """Return the course of a body that stays at a point (3,), and sways there."""
    zero, yaw = np.zeros(1), np.array([yaw_rad])
    return Course(zero, point[None], yaw, zero, zero, zero, zero, 0.0, 0.0, offset_s, False, sway_rad)
