"""A person who walks or stands: eleven links, and a gait in which the foot on the floor does not slide.

The gait is planar. For half of the stride a foot stays where it was put down; the leg above it is an inverted pendulum
and carries the hip. For the other half the foot swings forward, and the knee bends as two-link inverse kinematics says.
There is no double support and no rolling of the foot, so the hip bobs more than a real one.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from sim.movers.body import Body, Link, Moment, pitch_poses
from sim.props.parts import Point, block, hull_mesh, prism, rod, surface
from sim.props.shapes import Solid

# Lengths as shares of the stature: Drillis and Contini 1966, as in D. Winter, Biomechanics and Motor Control of Human
# Movement (cited from memory, unverified).
_THIGH, _SHANK, _ANKLE = 0.245, 0.246, 0.039
_HIP_HALF, _SHOULDER_HALF = 0.0955 / 2, 0.129
_SHOULDER, _UPPER_ARM, _FOREARM, _HAND = 0.818, 0.186, 0.146, 0.108
_CHIN = 0.87
# The ratio of step length to steps a minute is the same at all usual speeds (walk ratio). At 62 m/min it is 98 steps
# a minute: Murakami and Otaka, J. Phys. Ther. Sci. 2017 (PMC5430280). So 1.3 m/s has 1.83 steps a second of 0.71 m.
_WALK_RATIO_M_MIN = 62.0 / 98.0**2
# Ours, unverified: share of the straight leg that the standing leg has, lift of the swinging foot, arms and lean.
_STRAIGHTNESS = 0.985
_LIFT_M = 0.09
_ARM_SWING_RAD = np.deg2rad(22.0)
_ELBOW_RAD = np.deg2rad(-25.0)
_LEAN_RAD = np.deg2rad(3.0)
_GESTURE_RAD = np.deg2rad(18.0)
_GESTURE_S = 5.0
_SIDES = (("left", 1.0, 0.0), ("right", -1.0, 0.5))  # side, its sign, share of the stride by which it is ahead


def step_length_m(speed_mps: float) -> float:
    """Return the length of a step at a walking speed: the root of speed times walk ratio."""
    return float(np.sqrt(_WALK_RATIO_M_MIN * 60.0 * speed_mps))


class Person(Body):
    """A person of some height who walks at some speed, or stands where it is 0."""

    def __init__(self, height_m: float, speed_mps: float) -> None:
        self.height_m = height_m
        self.step_m = step_length_m(speed_mps)
        self.links = _links(height_m)
        self.period = (2.0 * self.step_m, _GESTURE_S)

    def place_links(self, moment: Moment) -> Float64Array:
        """Return root_T_link (11, T, 4, 4): trunk, then thigh, shank, foot, upper arm and forearm of either side."""
        feet = [self._foot(moment, ahead) for _, _, ahead in _SIDES]
        step = self.step_m * moment.activity
        stance_x = np.where(_is_stance(self._stride(moment, 0.0)), feet[0][0], feet[1][0])
        leg_m = _STRAIGHTNESS * self._leg_m
        crouch_m = np.abs(moment.slope) * step / 2  # so that the lower foot of a step on a ramp is reached
        hip_z = _ANKLE * self.height_m + np.sqrt(leg_m**2 - stance_x * stance_x) - crouch_m
        lean = _LEAN_RAD * moment.activity
        poses = [pitch_poses(lean, np.zeros_like(hip_z), 0.0, hip_z)]
        for (_, side, ahead), foot in zip(_SIDES, feet, strict=True):
            poses += self._leg(side, foot, hip_z)
            poses += self._arm(moment, side, ahead, hip_z, lean)
        return np.stack(poses)

    @property
    def _leg_m(self) -> float:
        return (_THIGH + _SHANK) * self.height_m

    def _stride(self, moment: Moment, ahead: float) -> Float64Array:
        """Return the share of the stride (T,) in [0, 1) of a leg; the foot is on the floor in the first half."""
        return np.asarray((moment.way_m / (2.0 * self.step_m) + ahead) % 1.0 if self.step_m else 0.0 * moment.way_m)

    def _foot(self, moment: Moment, ahead: float) -> tuple[Float64Array, Float64Array]:
        """Return how far ahead of the hip (T,) a foot is, and how high above the floor's mean plane."""
        stride, step = self._stride(moment, ahead), self.step_m * moment.activity
        swing = np.clip(2.0 * stride - 1.0, 0.0, 1.0)
        eased = swing * swing * (3.0 - 2.0 * swing)
        x = step * np.where(_is_stance(stride), 0.5 - 2.0 * stride, eased - 0.5)
        lift_m = _LIFT_M * moment.activity * np.sin(np.pi * swing) ** 2
        return x, lift_m + moment.slope * x

    def _leg(self, side: float, foot: tuple[Float64Array, Float64Array], hip_z: Float64Array) -> list[Float64Array]:
        """Return the poses of thigh, shank and foot: the knee is ahead of the line from hip to ankle."""
        thigh_m, shank_m, y = _THIGH * self.height_m, _SHANK * self.height_m, side * _HIP_HALF * self.height_m
        x, drop_m = foot[0], hip_z - (foot[1] + _ANKLE * self.height_m)
        reach_m = np.minimum(np.sqrt(x * x + drop_m * drop_m), (1.0 - 1e-9) * (thigh_m + shank_m))
        towards = np.arctan2(-x, drop_m)
        at_hip = np.arccos((thigh_m**2 + reach_m**2 - shank_m**2) / (2.0 * thigh_m * reach_m))
        at_knee = np.arccos((thigh_m**2 + shank_m**2 - reach_m**2) / (2.0 * thigh_m * shank_m))
        thigh = towards - at_hip
        shank = thigh + np.pi - at_knee
        knee_x, knee_z = -thigh_m * np.sin(thigh), hip_z - thigh_m * np.cos(thigh)
        ankle_x, ankle_z = knee_x - shank_m * np.sin(shank), knee_z - shank_m * np.cos(shank)
        return [
            pitch_poses(thigh, np.zeros_like(hip_z), y, hip_z),
            pitch_poses(shank, knee_x, y, knee_z),
            pitch_poses(np.zeros_like(shank), ankle_x, y, ankle_z),
        ]

    def _arm(
        self, moment: Moment, side: float, ahead: float, hip_z: Float64Array, lean: Float64Array
    ) -> list[Float64Array]:
        """Return the poses of upper arm and forearm: against the leg of their side; who stands moves a forearm."""
        up_m = (_SHOULDER - _THIGH - _SHANK - _ANKLE) * self.height_m
        x, z = up_m * np.sin(lean), hip_z + up_m * np.cos(lean)
        upper = _ARM_SWING_RAD * moment.activity * np.cos(2.0 * np.pi * self._stride(moment, ahead))
        talk = np.sin(2.0 * np.pi * (moment.time_s / _GESTURE_S + ahead)) * (1.0 - moment.activity)
        fore = upper + _ELBOW_RAD + _GESTURE_RAD * talk
        arm_m, y = _UPPER_ARM * self.height_m, side * (_SHOULDER_HALF + 0.015) * self.height_m
        elbow_x, elbow_z = x - arm_m * np.sin(upper), z - arm_m * np.cos(upper)
        return [pitch_poses(upper, x, y, z), pitch_poses(fore, elbow_x, y, elbow_z)]


def _is_stance(stride: Float64Array) -> BoolArray:
    return np.asarray(stride < 0.5)


def _links(height_m: float) -> tuple[Link, ...]:
    links = [Link("trunk", _trunk(height_m))]
    for side, _, _ in _SIDES:
        links.append(Link(f"{side} thigh", (_limb(_THIGH * height_m, 0.075, 0.06, "fabric"),)))
        shank = _limb(_SHANK * height_m, 0.055, 0.045, "fabric")
        links.append(Link(f"{side} shank", (shank, rod((0, 0, -0.2), (0, 0, -0.25), 0.062, "reflector"))))
        links.append(Link(f"{side} foot", (_boot(height_m),)))
        links.append(Link(f"{side} upper arm", (_limb(_UPPER_ARM * height_m, 0.05, 0.045, "fabric"),)))
        hand_m = (_FOREARM + 0.8 * _HAND) * height_m
        links.append(Link(f"{side} forearm", (_limb(hand_m, 0.042, 0.035, "fabric"),)))
    return tuple(links)


def _trunk(height_m: float) -> tuple[Solid, ...]:
    """Build pelvis, chest with two reflecting bands, head and helmet above the middle of the hips."""
    hip_m = (_THIGH + _SHANK + _ANKLE) * height_m
    shoulder, chin, crown = (share * height_m - hip_m for share in (_SHOULDER, _CHIN, 1.0))
    chest: Point = (0.11, 0.9 * _SHOULDER_HALF * height_m, shoulder)
    waist: Point = (0.10, 0.14, 0.12)
    bands = (0.45, 0.75)
    solids = [
        _taper((0.10, 0.16, -0.1), waist, "fabric"),
        _taper(waist, chest, "fabric"),
        rod((0.0, 0.0, shoulder), (0.01, 0.0, chin), 0.06, "fabric"),
        _taper((0.085, 0.07, chin), (0.1, 0.075, crown - 0.08), "fabric"),
        block((-0.11, -0.09, crown - 0.09), (0.14, 0.09, crown - 0.075), "plastic"),
        _taper((0.115, 0.09, crown - 0.075), (0.07, 0.06, crown), "plastic"),
    ]
    for share in bands:
        z = waist[2] + share * (shoulder - waist[2])
        x, y = (low + share * (high - low) + 0.006 for low, high in zip(waist[:2], chest[:2], strict=True))
        solids.append(_taper((x, y, z), (x, y, z + 0.05), "reflector"))
    return tuple(solids)


def _limb(length_m: float, upper_m: float, lower_m: float, material: str) -> Solid:
    """Return an eight-sided limb that hangs down from the origin."""
    angle = np.arange(8) * (np.pi / 4)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    profile = ((0.8 * upper_m, 0.03), (upper_m, -0.02), (lower_m, 0.02 - length_m), (0.8 * lower_m, -length_m))
    rings = [np.column_stack([radius * ring, np.full(8, z)]) for radius, z in profile]
    return surface(hull_mesh(np.concatenate(rings)), material)


def _taper(low: Point, high: Point, material: str) -> Solid:
    """Return an eight-sided piece about the z axis between two ovals of (half x, half y, z)."""
    angle = (np.arange(8) + 0.5) * (np.pi / 4)
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) / np.cos(np.pi / 8)
    rings = [np.column_stack([ring * (x, y), np.full(8, z)]) for x, y, z in (low, high)]
    return surface(hull_mesh(np.concatenate(rings)), material)


def _boot(height_m: float) -> Solid:
    """Return a boot below the ankle; its sole is at floor level."""
    ankle = _ANKLE * height_m
    outline = ((-0.07, -ankle), (0.2, -ankle), (0.2, 0.05 - ankle), (0.05, 0.04), (-0.06, 0.04))
    return prism(outline, 0.05, "rubber")
