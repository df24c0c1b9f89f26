"""Machines: a counterbalance forklift with a carriage that rises, and a load-haul-dump loader that bends in its middle.

Proportions are ours, after common machines of that size (unverified); each fills its length, width and height with the
load lowered.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cdpipe.core.geometry import Float64Array, make_pose
from sim.movers.body import Body, Link, Moment, compose_poses, pitch_poses
from sim.props.parts import beam, block, prism, rod
from sim.props.shapes import Size, Solid

# Ours, unverified: how far the forks rise, how far boom and bucket turn.
_FORK_RISE_M = 0.9
_BOOM_RAD = np.deg2rad(-32.0)
_CURL_RAD = np.deg2rad(-38.0)
_TICK_S = 1.0  # a machine has no movement of its own in time


class Forklift(Body):
    """A forklift that faces +x; it lifts its forks at the far end of its stretch and lowers them at the near one."""

    def __init__(self, size_m: Size) -> None:
        self.links = (Link("truck", _truck(size_m)), Link("carriage", _carriage(size_m)))
        self.period = (1.0, _TICK_S)
        self.rise_m = min(_FORK_RISE_M, 0.4 * size_m[2])

    def place_links(self, moment: Moment) -> Float64Array:
        """Return root_T_link (2, T, 4, 4): truck, carriage."""
        zero = np.zeros_like(moment.turned)
        level = pitch_poses(zero, zero, 0.0, zero)
        return np.stack([level, pitch_poses(zero, zero, 0.0, self.rise_m * moment.turned)])


class Loader(Body):
    """A loader that faces +x, root at its joint; it carries its bucket high on the way back, with muck in it."""

    is_bending = True

    def __init__(self, size_m: Size) -> None:
        length, _, height = size_m
        self.links = (
            Link("rear", _rear_frame(size_m)),
            Link("front", _front_frame(size_m)),
            Link("boom", _boom(size_m)),
            Link("bucket", _bucket(size_m)),
        )
        self.period = (1.0, _TICK_S)
        self.wheelbase_m = 0.38 * length
        self.pivot = (0.1 * length, 0.6 * height)
        self.boom = (0.2 * length, -0.4 * height)  # from the pivot to the bucket's pin, lowered

    def place_links(self, moment: Moment) -> Float64Array:
        """Return root_T_link (4, T, 4, 4): rear frame, front frame, boom, bucket."""
        bend_rad = np.arctan(moment.bend_per_m * self.wheelbase_m)
        rear, front = _yaw_poses(-bend_rad / 2), _yaw_poses(bend_rad / 2)
        zero = np.zeros_like(bend_rad)
        boom_rad, (reach, drop) = _BOOM_RAD * moment.turned, self.boom
        cos, sin = np.cos(boom_rad), np.sin(boom_rad)
        pin_x, pin_z = self.pivot[0] + reach * cos + drop * sin, self.pivot[1] - reach * sin + drop * cos
        boom = pitch_poses(boom_rad, zero + self.pivot[0], 0.0, zero + self.pivot[1])
        bucket = pitch_poses(_CURL_RAD * moment.turned, pin_x, 0.0, pin_z)
        return np.stack([rear, front, compose_poses(front, boom), compose_poses(front, bucket)])


def _yaw_poses(angle_rad: Float64Array) -> Float64Array:
    """Return poses (T, 4, 4) turned by angles (T,) about z."""
    cos, sin, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad), np.ones_like(angle_rad)
    rotation = np.stack([np.stack(row, -1) for row in ((cos, -sin, zero), (sin, cos, zero), (zero, zero, one))], -2)
    return make_pose(rotation, np.zeros((len(angle_rad), 3)))


def _wheels(axle: float, radius: float, width: float, tread: float) -> list[Solid]:
    """Return the two wheels of an axle: tyres out to the machine's width, rims inside them."""
    solids = []
    for side in (-1.0, 1.0):
        outer, inner = side * width / 2, side * (width / 2 - tread)
        solids.append(rod((axle, outer, radius), (axle, inner, radius), radius, "rubber"))
        solids.append(rod((axle, outer + 0.01 * side, radius), (axle, outer, radius), 0.5 * radius, "steel"))
    return solids


def _truck(size_m: Size) -> tuple[Solid, ...]:
    """Build counterweight, chassis, wheels, overhead guard on four pillars, seat, driver's back rest and outer mast."""
    length, width, height = size_m
    rear, front = -0.5 * length, 0.12 * length  # the forks reach from there to the front
    half, deck, guard = 0.48 * width, 0.42 * height, 0.95 * height
    solids = [
        prism([(rear, 0.12 * height), (rear + 0.02, 0.4 * height), (rear + 0.25 * length, 0.5 * height),
               (rear + 0.25 * length, 0.1 * height)], half, "paint"),
        block((rear + 0.25 * length, -half, 0.1 * height), (front, half, 0.26 * height), "paint"),
        block((rear + 0.2 * length, -0.3 * width, 0.26 * height), (rear + 0.38 * length, 0.3 * width, deck), "plastic"),
        block((rear + 0.22 * length, -0.22 * width, deck),
              (rear + 0.25 * length, 0.22 * width, 0.66 * height), "fabric"),
        block((front - 0.05, -half, 0.26 * height), (front, half, deck), "paint"),
        block((rear + 0.16 * length, -half, guard), (front, half, height), "paint"),
    ]  # fmt: skip
    for x in (rear + 0.18 * length, front - 0.04):
        for side in (-1.0, 1.0):
            y = side * (half - 0.04)
            solids.append(beam((x, y, deck - 0.2 * height), (x, y, guard), 0.06, 0.06, "steel"))
    for side in (-1.0, 1.0):
        low, high = sorted((side * 0.2 * width, side * 0.28 * width))
        solids.append(block((front, low, 0.06 * height), (front + 0.05, high, 0.98 * height), "steel"))
    solids += _wheels(front - 0.1 * length, 0.16 * height, width, 0.2 * width)
    return (*solids, *_wheels(rear + 0.12 * length, 0.12 * height, 0.9 * width, 0.16 * width))


def _carriage(size_m: Size) -> tuple[Solid, ...]:
    """Build the fork carriage, two forks and a load rest, lowered."""
    length, width, height = size_m
    back, tip = 0.12 * length + 0.05, 0.5 * length
    solids = [block((back, -0.45 * width, 0.04 * height), (back + 0.05, 0.45 * width, 0.28 * height), "steel")]
    for side in (-1.0, 1.0):
        low, high = sorted((side * 0.18 * width, side * 0.3 * width))
        solids.append(block((back + 0.05, low, 0.03 * height), (tip, high, 0.05 * height), "steel"))
        solids.append(beam((back + 0.03, side * 0.42 * width, 0.28 * height),
                           (back + 0.03, side * 0.42 * width, 0.55 * height), 0.04, 0.04, "steel"))  # fmt: skip
    return (*solids, block((back, -0.44 * width, 0.53 * height), (back + 0.05, 0.44 * width, 0.56 * height), "steel"))


def _rear_frame(size_m: Size) -> tuple[Solid, ...]:
    """Build engine hood, side-seated cab with canopy, wheels and reflectors behind the joint."""
    length, width, height = size_m
    rear, axle, radius = -0.5 * length, -0.19 * length, 0.36 * height
    hood = [(rear, 0.3 * height), (rear, 0.62 * height), (rear + 0.05 * length, 0.7 * height),
            (-0.08 * length, 0.7 * height), (-0.08 * length, 0.3 * height)]  # fmt: skip
    solids = [
        prism(hood, 0.3 * width, "paint"),
        prism([(rear, 0.3 * height), (rear, 0.6 * height), (-0.32 * length, 0.6 * height),
               (-0.3 * length, 0.3 * height)], 0.49 * width, "paint"),
        block((-0.09 * length, -0.42 * width, 0.25 * height), (-0.02 * length, 0.42 * width, 0.68 * height), "paint"),
        block((-0.02 * length, -0.12 * width, 0.28 * height), (0.0, 0.12 * width, 0.5 * height), "steel"),
        block((-0.1 * length, 0.05 * width, 0.95 * height), (0.0, 0.49 * width, height), "paint"),
        block((-0.085 * length, 0.12 * width, 0.68 * height), (-0.065 * length, 0.4 * width, 0.85 * height), "fabric"),
        rod((axle, -0.4 * width, radius), (axle, 0.4 * width, radius), 0.2 * radius, "steel"),
    ]  # fmt: skip
    for x in (-0.095 * length, -0.005 * length):
        pillar = partial(beam, width_m=0.07, depth_m=0.07, material="steel")
        solids += [pillar((x, y, 0.66 * height), (x, y, 0.95 * height)) for y in (0.08 * width, 0.46 * width)]
    for side in (-1.0, 1.0):
        low, high = sorted((side * 0.36 * width, side * 0.46 * width))
        solids.append(block((rear - 0.005, low, 0.45 * height), (rear, high, 0.53 * height), "reflector"))
    return (*solids, *_wheels(axle, radius, width, 0.2 * width))


def _front_frame(size_m: Size) -> tuple[Solid, ...]:
    """Build the frame between the front wheels and the two cheeks that hold the boom."""
    length, width, height = size_m
    axle, radius = 0.19 * length, 0.36 * height
    frame = [(0.0, 0.25 * height), (0.0, 0.5 * height), (0.24 * length, 0.45 * height), (0.24 * length, 0.22 * height)]
    solids = [prism(frame, 0.25 * width, "paint")]
    solids.append(rod((axle, -0.4 * width, radius), (axle, 0.4 * width, radius), 0.2 * radius, "steel"))
    for side in (-1.0, 1.0):
        low, high = sorted((side * 0.16 * width, side * 0.2 * width))
        solids.append(block((0.05 * length, low, 0.45 * height), (0.13 * length, high, 0.66 * height), "paint"))
    return (*solids, *_wheels(axle, radius, width, 0.2 * width))


def _boom(size_m: Size) -> tuple[Solid, ...]:
    """Build the two arms from the pivot down to the bucket's pin, lowered, and the cross tube between them."""
    length, width, height = size_m
    pin = (0.2 * length, -0.4 * height)
    solids = []
    for side in (-1.0, 1.0):
        y = side * 0.11 * width
        solids.append(beam((0.0, y, 0.0), (pin[0], y, pin[1]), 0.05 * width, 0.12 * height, "paint"))
    return (*solids, rod((0.1 * length, -0.11 * width, -0.2 * height), (0.1 * length, 0.11 * width, -0.2 * height),
                         0.05 * height, "steel"))  # fmt: skip


def _bucket(size_m: Size) -> tuple[Solid, ...]:
    """Build floor, back, two sides and a heap of muck; the pin is the origin, the lip reaches the machine's front."""
    length, width, height = size_m
    lip, floor, wall = 0.2 * length, -0.19 * height, 0.02 * width
    half = 0.49 * width
    side = [(-0.02 * length, floor), (lip, floor), (0.12 * length, 0.2 * height), (-0.02 * length, 0.22 * height)]
    muck = [(0.0, floor + 0.02), (0.17 * length, floor + 0.02), (0.11 * length, 0.17 * height),
            (0.05 * length, 0.26 * height), (0.0, 0.2 * height)]  # fmt: skip
    solids = [block((-0.02 * length, -half, floor), (lip, half, floor + 0.02), "steel"),
              block((-0.02 * length, -half, floor), (0.0, half, 0.22 * height), "steel"),
              prism(muck, half - wall, "rock")]  # fmt: skip
    for sign in (-1.0, 1.0):
        plate = prism(side, wall / 2, "steel")
        plate.object_T_solid[1, 3] = sign * (half - wall / 2)
        solids.append(plate)
    return tuple(solids)
