"""Chairs, hand trolleys, traffic cones and railings."""

from __future__ import annotations

import numpy as np

from sim.props.parts import block, revolve, rod, surface
from sim.props.shapes import BELOW_FLOOR_M, Size, Solid


def chair(size_m: Size) -> tuple[Solid, ...]:
    """Build a visitor's chair: four tubular legs, a seat pad at half height, a back rest at the rear (-x)."""
    length, width, height = size_m
    x, y, seat = length / 2, width / 2, 0.48 * height
    tube = min(0.014, 0.04 * min(length, width))
    pad = min(0.05, 0.06 * height)
    inner_x, inner_y = x - tube, y - tube
    solids = [rod((inner_x, side, 0.0), (inner_x, side, seat), tube, "steel") for side in (-inner_y, inner_y)]
    solids += [rod((-inner_x, side, 0.0), (-inner_x, side, height), tube, "steel") for side in (-inner_y, inner_y)]
    solids += [
        rod((-inner_x, side, 0.5 * seat), (inner_x, side, 0.5 * seat), 0.8 * tube, "steel")
        for side in (-inner_y, inner_y)
    ]
    solids.append(rod((inner_x, -inner_y, seat - tube), (inner_x, inner_y, seat - tube), tube, "steel"))
    solids.append(block((2 * tube - x, -y, seat), (x, y, seat + pad), "fabric"))
    rest = seat + 0.42 * (height - seat)
    solids.append(block((-x, -y, rest), (pad - x, y, height), "fabric"))
    return tuple(solids)


def trolley(size_m: Size) -> tuple[Solid, ...]:
    """Build an upright sack truck: toe plate in front, two wheels, ladder frame and handle at the rear."""
    length, width, height = size_m
    x, y = length / 2, width / 2
    wheel = min(0.28 * length, 0.13 * height)
    axle, tread, tube = wheel - x, 0.1 * width, min(0.016, 0.04 * width)
    rear, inner = axle + 0.35 * wheel, y - 0.1 * width - 0.02
    rail = inner - tube
    solids = [rod((axle, side, wheel), (axle, side + tread, wheel), wheel, "rubber") for side in (-y, y - tread)]
    solids += [
        rod((axle, side - 0.004, wheel), (axle, side + 0.004, wheel), 0.55 * wheel, "steel")
        for side in (tread - y, y - tread)
    ]
    solids.append(rod((axle, tread - y, wheel), (axle, y - tread, wheel), 0.8 * tube, "steel"))
    solids.append(block((rear, -inner, 0.0), (x, inner, 0.012), "steel"))
    solids.append(block((rear, -inner, 0.0), (rear + 0.01, inner, 0.1 * height), "steel"))
    for side in (-rail, rail):
        solids.append(rod((rear, side, 0.01), (rear, side, 0.86 * height), tube, "paint"))
        solids.append(rod((rear, side, 0.86 * height), (axle, side, height - tube), tube, "paint"))
        solids.append(rod((rear, side, 2.2 * wheel), (axle, side, wheel), 0.7 * tube, "paint"))
    for share in (0.25, 0.45, 0.65):
        solids.append(rod((rear, -rail, share * height), (rear, rail, share * height), 0.8 * tube, "paint"))
    solids.append(rod((rear, 0.0, 0.1 * height), (rear, 0.0, 0.65 * height), 0.7 * tube, "paint"))
    solids.append(rod((axle, -inner, height - tube), (axle, inner, height - tube), tube, "rubber"))
    return tuple(solids)


def cone(size_m: Size) -> tuple[Solid, ...]:
    """Build a traffic cone: square foot, cone open at the top, two reflective bands."""
    length, width, height = size_m
    foot = 0.06 * height
    low, high = 0.74, 0.13  # radii above the foot and at the top, as shares of the half size

    def radius(z: float) -> float:
        return low + (high - low) * (z - foot) / (height - foot)

    inner = [(high - 0.05, height), (high - 0.05 + 0.1 * (low - high), 0.9 * height), (0.0, 0.9 * height)]
    shell = [(0.0, 0.5 * foot), (low + 0.05, 0.5 * foot), (low + 0.05, foot), (low, foot), (high, height), *inner]
    solids = [
        block((-length / 2, -width / 2, 0.0), (length / 2, width / 2, foot), "rubber"),
        surface(revolve(shell, length, width), "plastic"),
    ]
    for start, stop in ((0.42, 0.58), (0.72, 0.82)):
        band = [(radius(z * height) + 0.012, z * height) for z in (start, stop)]
        solids.append(surface(revolve([(0.0, band[0][1]), *band, (0.0, band[1][1])], length, width), "reflector"))
    return tuple(solids)


def railing(size_m: Size) -> tuple[Solid, ...]:
    """Build a railing: posts set into the floor at most 1.5 m apart, foot plates, three rails and a toe board."""
    length, width, height = size_m
    x = length / 2
    post, rail = min(0.03, width / 2), min(0.024, width / 2)
    foot = max(post, width / 2)
    places = np.linspace(foot - x, x - foot, max(2, int(np.ceil(length / 1.5)) + 1)).tolist()
    solids = [rod((place, 0.0, -BELOW_FLOOR_M), (place, 0.0, height), post, "steel") for place in places]
    solids += [rod((-x, 0.0, z), (x, 0.0, z), rail, "paint") for z in (0.35 * height, 0.65 * height, height - rail)]
    solids += [block((place - foot, -width / 2, 0.0), (place + foot, width / 2, 0.015), "steel") for place in places]
    solids.append(block((-x, post - 0.006, 0.02), (x, post, 0.02 + 0.12 * height), "paint"))
    return tuple(solids)
