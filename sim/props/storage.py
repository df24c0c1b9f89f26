"""Storage props: boxes, crates, barrels and pallets."""

from __future__ import annotations

from sim.props.parts import beam, block, revolve, rod, surface
from sim.props.shapes import Size, Solid

_EUR_PALLET_M = 0.144


def box(size_m: Size, is_cardboard: bool) -> tuple[Solid, ...]:
    """Build a box of cardboard or steel with a groove below its lid."""
    length, width, height = size_m
    material = "paper" if is_cardboard else "paint"
    x, y, low, high = length / 2, width / 2, 0.8 * height, 0.83 * height
    inset = 0.015 * min(length, width)
    return (
        block((-x, -y, 0.0), (x, y, low), material),
        block((inset - x, inset - y, low), (x - inset, y - inset, high), material),
        block((-x, -y, high), (x, y, height), material),
    )


def crate(size_m: Size) -> tuple[Solid, ...]:
    """Build a slatted crate: skids, floor, slats with gaps, battens at the corners, diagonal battens, lid."""
    length, width, height = size_m
    x, y = length / 2, width / 2
    board = min(0.022, 0.04 * min(size_m))
    skid, batten = 0.09 * height, min(0.09, 0.12 * min(length, width))
    wall = (x - board, y - board)  # outside of the slats
    middles = (batten / 2 - y, 0.0, y - batten / 2)
    solids = [block((-x, at - batten / 2, 0.0), (x, at + batten / 2, skid), "wood") for at in middles]
    solids.append(block((-wall[0], -wall[1], skid), (*wall, skid + board), "wood"))
    for low, high in _slats(skid, height - board, 0.14, 0.02 * height + 0.006):
        solids += [block((-wall[0], a, low), (wall[0], b, high), "wood") for a, b in _both(wall[1] - board, wall[1])]
        inner = wall[1] - board
        solids += [block((a, -inner, low), (b, inner, high), "wood") for a, b in _both(wall[0] - board, wall[0])]
    top = height - board
    corners = [(ends, sides) for ends in _both(x - batten, x) for sides in _both(wall[1], y)]
    corners += [(ends, sides) for ends in _both(wall[0], x) for sides in _both(wall[1] - batten, wall[1])]
    solids += [block((ends[0], sides[0], skid), (ends[1], sides[1], top), "wood") for ends, sides in corners]
    for side in (-1, 1):
        reach, at = side * (x - batten), side * (y - board / 2)
        start, end = (-reach, at, skid + 0.75 * batten), (reach, at, top - 0.75 * batten)
        solids.append(beam(start, end, board, batten, "wood"))
    solids += [block((a, -y, top), (b, y, height), "wood") for a, b in _slats(-x, x, 0.16, 0.015)]
    return tuple(solids)


def _slats(start: float, stop: float, pitch: float, gap: float) -> list[tuple[float, float]]:
    """Return the ranges of boards from `start` to `stop` with gaps between them."""
    n = max(3, round((stop - start) / pitch))
    size = (stop - start - (n - 1) * gap) / n
    return [(start + number * (size + gap), start + number * (size + gap) + size) for number in range(n)]


def _both(inside: float, outside: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a range on the positive side and its mirror image."""
    return (inside, outside), (-outside, -inside)


def barrel(size_m: Size) -> tuple[Solid, ...]:
    """Build a steel drum: two rolling rings, a rim at both ends, sunken ends and two bungs."""
    length, width, height = size_m
    rim, body, sunk = 0.02 * height, 0.965, 0.02 * height
    profile = [(0.0, sunk), (0.95, sunk), (0.96, 0.0), (0.985, 0.0), (0.985, rim), (body, rim)]
    for ring in (1 / 3, 2 / 3):
        profile += [(body, (ring - 0.022) * height), (1.0, (ring - 0.008) * height)]
        profile += [(1.0, (ring + 0.008) * height), (body, (ring + 0.022) * height)]
    profile += [(body, height - rim), (0.985, height - rim), (0.985, height), (0.96, height)]
    profile += [(0.95, height - sunk), (0.0, height - sunk)]
    bungs = [
        rod((share * length, 0.0, height - sunk), (share * length, 0.0, height - 0.4 * sunk), radius, "steel")
        for share, radius in ((0.33, 0.06 * length), (-0.36, 0.035 * length))
    ]
    return (surface(revolve(profile, length, width), "paint"), *bungs)


def pallet(size_m: Size) -> tuple[Solid, ...]:
    """Build a EUR pallet (EN 13698-1, scaled to the size), or a stack of as many as the height holds."""
    length, width, height = size_m
    n = max(1, round(height / _EUR_PALLET_M))
    return tuple(part for level in range(n) for part in _one_pallet(length, width, level * height / n, height / n))


def _one_pallet(length: float, width: float, floor: float, height: float) -> list[Solid]:
    x, y = length / 2, width / 2
    board, foot = 22 / 144 * height, floor + 22 / 144 * height
    deck = floor + 122 / 144 * height
    wide, narrow, along = 0.145 / 0.8 * width, 0.1 / 0.8 * width, 0.145 / 1.2 * length
    ways = ((-y, narrow), (-wide / 2, wide), (y - narrow, narrow))
    solids = [block((-x, start, floor), (x, start + size, foot), "wood") for start, size in ways]
    for end in (-x, -along / 2, x - along):
        for start, size in ways:
            solids.append(block((end, start, foot), (end + along, start + size, deck - board), "wood"))
        solids.append(block((end, -y, deck - board), (end + along, y, deck), "wood"))
    gap = (width - 3 * wide - 2 * narrow) / 4
    start = -y
    for size in (wide, narrow, wide, narrow, wide):
        solids.append(block((-x, start, deck), (x, start + size, floor + height), "wood"))
        start += size + gap
    return solids
