"""A parked light utility vehicle."""

from __future__ import annotations

from sim.props.parts import Point, block, hull_mesh, prism, rod, surface
from sim.props.shapes import Size, Solid

# Along the length, rear to front, as shares of the length from the middle.
_REAR_AXLE, _FRONT_AXLE = -0.29, 0.31
_CAB_REAR, _CAB_FRONT, _ROOF_REAR, _ROOF_FRONT = -0.12, 0.24, -0.10, 0.12
# Heights, as shares of the height.
_SILL, _WAIST, _DECK, _ROOF = 0.25, 0.56, 0.42, 0.92


def vehicle(size_m: Size) -> tuple[Solid, ...]:
    """Build a pick-up that faces +x: chassis, wheels, bonnet, cab with pillars and panes, load bed, beacon."""
    length, _, height = size_m
    wheel = min(0.2 * height, 0.1 * length)
    return (*_running_gear(size_m, wheel), *_body(size_m), *_cab(size_m), *_load_bed(size_m))


def _running_gear(size_m: Size, wheel: float) -> list[Solid]:
    length, width, height = size_m
    tread = 0.13 * width
    solids = [block((-0.47 * length, -0.3 * width, 0.8 * wheel), (0.46 * length, 0.3 * width, _SILL * height), "steel")]
    for axle in (_REAR_AXLE * length, _FRONT_AXLE * length):
        solids.append(rod((axle, -0.4 * width, wheel), (axle, 0.4 * width, wheel), 0.2 * wheel, "steel"))
        for outside, inside in ((-width / 2, tread - width / 2), (width / 2, width / 2 - tread)):
            sign = 1.0 if outside > 0 else -1.0
            solids.append(rod((axle, outside - 0.004 * sign, wheel), (axle, inside, wheel), wheel, "rubber"))
            solids.append(rod((axle, outside, wheel), (axle, inside, wheel), 0.5 * wheel, "steel"))
    for end, material in ((-0.5, "steel"), (0.47, "plastic")):
        low = (end * length, -0.44 * width, 0.8 * wheel)
        solids.append(block(low, ((end + 0.03) * length, 0.44 * width, 0.27 * height), material))
    return solids


def _body(size_m: Size) -> list[Solid]:
    """Build bonnet, wings between the wheels, lamps and plate."""
    length, width, height = size_m
    nose, half = 0.48 * length, 0.46 * width
    arch = 0.4 * height  # above the wheels
    bonnet = [(0.19 * length, arch), (nose, arch), (nose, 0.5 * height), (0.46 * length, 0.53 * height)]
    solids = [prism([*bonnet, (_CAB_FRONT * length, _WAIST * height), (0.19 * length, _WAIST * height)], half, "paint")]
    solids.append(block((0.41 * length, -half, _SILL * height), (nose, half, arch), "paint"))
    solids.append(block((0.2 * length, -0.33 * width, _SILL * height), (0.42 * length, 0.33 * width, arch), "steel"))
    solids.append(block((_CAB_REAR * length, -half, _SILL * height), (0.21 * length, half, _WAIST * height), "paint"))
    for side in (-1, 1):
        low, high = sorted((side * 0.3 * width, side * 0.45 * width))
        solids.append(block((nose, low, 0.42 * height), (nose + 0.006 * length, high, 0.49 * height), "glass"))
    solids.append(
        block((nose, -0.25 * width, 0.32 * height), (nose + 0.004 * length, 0.25 * width, 0.47 * height), "plastic")
    )
    return solids


def _cab(size_m: Size) -> list[Solid]:
    """Build pillars and panes that lean inwards from the waist to the roof, mirrors and a beacon."""
    length, width, height = size_m
    waist, roof = _WAIST * height, _ROOF * height
    base, top, edge, glass = 0.44 * width, 0.40 * width, 0.012 * length, 0.004
    solids = [
        block(
            ((_ROOF_REAR - 0.015) * length, -top - edge, roof),
            ((_ROOF_FRONT + 0.015) * length, top + edge, 0.95 * height),
            "paint",
        )
    ]
    pillars = ((_CAB_FRONT - 0.015, _ROOF_FRONT), (0.03, 0.02), (_CAB_REAR + 0.015, _ROOF_REAR))
    for low, high in pillars:
        for side in (-1, 1):
            foot, head = (low * length, side * base, waist), (high * length, side * top, roof)
            solids.append(_rising(foot, (edge, edge), head, (edge, edge), "paint"))
    for low, high in (pillars[0], pillars[2]):
        foot, head = (low * length, 0.0, waist), (high * length, 0.0, roof)
        solids.append(_rising(foot, (glass, base), head, (glass, top), "glass"))
    (front, roof_front), _, (rear, roof_rear) = pillars
    for side in (-1, 1):
        foot, head = (
            ((front + rear) / 2 * length, side * base, waist),
            ((roof_front + roof_rear) / 2 * length, side * top, roof),
        )
        spans = (front - rear) / 2 * length, (roof_front - roof_rear) / 2 * length
        solids.append(_rising(foot, (spans[0], glass), head, (spans[1], glass), "glass"))
        low_y, high_y = sorted((side * base, side * width / 2))
        solids.append(block((0.18 * length, low_y, waist), (0.195 * length, high_y, waist + 0.1 * height), "plastic"))
    solids.append(rod((0.0, 0.0, 0.95 * height), (0.0, 0.0, height), 0.035 * width, "plastic"))
    return solids


def _load_bed(size_m: Size) -> list[Solid]:
    """Build floor, two sides above the wheels, head board, tail gate and rear reflectors."""
    length, width, height = size_m
    rear, front, half, wall = -0.49 * length, (_CAB_REAR - 0.005) * length, 0.46 * width, 0.02 * width
    deck, top = _DECK * height, (_WAIST + 0.01) * height
    solids = [block((rear, -half, deck - 0.03 * height), (front, half, deck), "paint")]
    solids += [block((rear, side, deck), (front, side + wall, top), "paint") for side in (-half, half - wall)]
    solids += [block((end, wall - half, deck), (end + wall, half - wall, top), "paint") for end in (rear, front - wall)]
    for side in (-1, 1):
        low, high = sorted((side * 0.36 * width, side * 0.45 * width))
        solids.append(block((rear - 0.004 * length, low, 0.43 * height), (rear, high, 0.53 * height), "reflector"))
    return solids


def _rising(
    foot: Point, foot_half: tuple[float, float], head: Point, head_half: tuple[float, float], material: str
) -> Solid:
    """Return the convex piece between two level rectangles given by middle and half sides."""
    corners = [
        (x + sign_x * half_x, y + sign_y * half_y, z)
        for (x, y, z), (half_x, half_y) in ((foot, foot_half), (head, head_half))
        for sign_x in (-1, 1)
        for sign_y in (-1, 1)
    ]
    return surface(hull_mesh(corners), material)
