"""Obstacles of a robot: props beside its line, and the rock around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from operator import itemgetter

import numpy as np
from scipy import ndimage

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array
from scenarios.schema import Scenario
from sim.geometry.line import STEP_M
from sim.geometry.raycast import measure_room
from sim.placement.lanes import AIR_BELOW_M, project_prop
from sim.placement.placing import PROBE_UP_M, floor_heights, standing_height_m
from sim.rock.centreline import left_of
from sim.scene import World

# Loose stones up to this height are driven over.
_STRADDLED_M = 0.15
# Samples across the drift when stones are looked for, and free way beside the wheels.
_ACROSS_M = 0.1
_BESIDE_WHEELS_M = 0.1
# The body checked against the walls: the true gap may be this share of the clearance where the wall bulges.
_TIGHTEST_SHARE = 0.5
# So many obstacles beside one another get their sides together; no drift is wide enough for more.
_MOST_ABREAST = 7

Span = tuple[Float64Array, Float64Array]  # lowest and highest forbidden offset, (N,) each, NaN where all are free


def find_obstacles(
    world: World, scenario: Scenario, session: str, line: Float64Array, headings: Float64Array, height_m: float
) -> list[tuple[str, Float64Array, Float64Array]]:
    """Return what each prop and heap of rubble in the way is, and the offsets it forbids, (N,) to (N,), NaN if far."""
    clearance_m = scenario.platform.clearance_m
    found = []
    for item in world.standing:
        is_low = scenario.platform.kind == "quadrotor" and standing_height_m(item) + AIR_BELOW_M < height_m
        if session not in item.sessions or is_low:
            continue
        near, along, across = project_prop(item, line[:, :2], headings, (clearance_m, 10.0))
        reach_m = np.sqrt(np.maximum(clearance_m**2 - along**2, 0.0))
        is_abreast = np.abs(along) < clearance_m
        low, high = np.full(len(line), np.nan), np.full(len(line), np.nan)
        low[near] = np.where(is_abreast, across - reach_m, np.inf).min(axis=1)
        high[near] = np.where(is_abreast, across + reach_m, -np.inf).max(axis=1)
        away = ~(low < high)
        low[away] = high[away] = np.nan
        found.append((f"prop {item.prop.name!r}", low, high))
    for name, places in world.heaps:
        is_low = scenario.platform.kind == "quadrotor" and float(np.ptp(places[:, 2])) + AIR_BELOW_M < height_m
        if len(places) and not is_low:
            found.append((f"the rubble of surface {name!r}", *_keep_off(places[:, :2], line, headings, clearance_m)))
    return found


def _keep_off(places: Float64Array, line: Float64Array, headings: Float64Array, clearance_m: float) -> Span:
    """Return the offsets (N,) that places (K, 2) forbid to a line that keeps clear of them."""
    low, high = np.full(len(line), np.nan), np.full(len(line), np.nan)
    left = left_of(headings)
    middle = places.mean(axis=0)
    reach_m = float(np.linalg.norm(places - middle, axis=1).max()) + clearance_m + 10.0
    for station in np.flatnonzero(np.linalg.norm(line[:, :2] - middle, axis=1) < reach_m).tolist():
        away = places - line[station, :2]
        along, across = away @ headings[station], away @ left[station]
        is_abreast = np.abs(along) < clearance_m
        if is_abreast.any():
            reach = np.sqrt(clearance_m**2 - along[is_abreast] ** 2)
            low[station] = (across[is_abreast] - reach).min()
            high[station] = (across[is_abreast] + reach).max()
    return low, high


def pass_obstacles(
    wanted: Float64Array, low: Float64Array, high: Float64Array, obstacles: Sequence[Span]
) -> tuple[int, int] | None:
    """Narrow the bounds of a line in place so that it passes all obstacles.

    Each is passed on the side that is nearer to where the line wants to be. Where the sides so chosen leave no room for
    one more, the sides of all obstacles abreast of it are chosen anew: of those that leave room the ones with the least
    detour.

    Args:
        wanted: (N,) wanted offset to the left at each sample of the line, metres.
        low: (N,) lower bound of the offset; changed in place.
        high: (N,) upper bound; changed in place.
        obstacles: What each forbids.

    Returns:
        Number of the obstacle that cannot be passed and the sample at which it bars the way, or None.
    """
    visits = [(number, visit) for number, (near_low, _) in enumerate(obstacles) for visit in _list_visits(near_low)]
    sides: dict[int, int] = {}  # of visits: 1 left, -1 right; the way back passes an obstacle on its other side
    while True:
        inner = low.copy(), high.copy()
        barred = _pass_each(wanted, *inner, obstacles, visits, sides)
        if barred is None:
            low[:], high[:] = inner
            return None
        number, there = visits[barred]
        group = [each for each in range(barred) if len(np.intersect1d(visits[each][1], there))][-_MOST_ABREAST:]
        tries = []
        for chosen in product((-1, 1), repeat=len(group) + 1):
            tried = {**sides, **dict(zip((*group, barred), chosen, strict=True))}
            inner = low.copy(), high.copy()
            if _pass_each(wanted, *inner, obstacles, visits[: barred + 1], tried) is None:
                detour_m = np.maximum(inner[0] - wanted, 0.0) + np.maximum(wanted - inner[1], 0.0)
                tries.append((float(detour_m.sum()), tried))
        if not tries:
            return number, int(there[0])
        sides = min(tries, key=itemgetter(0))[1]


def _list_visits(near_low: Float64Array) -> list[Int64Array]:
    """Return the samples (V,) of each time that a line comes by an obstacle, which forbids offsets there."""
    samples = np.flatnonzero(np.isfinite(near_low))
    return [each for each in np.split(samples, np.flatnonzero(np.diff(samples) > 1 / STEP_M) + 1) if len(each)]


def _pass_each(
    wanted: Float64Array,
    low: Float64Array,
    high: Float64Array,
    obstacles: Sequence[Span],
    visits: Sequence[tuple[int, Int64Array]],
    sides: Mapping[int, int],
) -> int | None:
    """Narrow the bounds by one visit after another, those with a side on that side; return the first without room."""
    for place, (number, visit) in enumerate(visits):
        near_low, near_high = obstacles[number]
        if not _pass_one(wanted, low, high, visit, (near_low[visit], near_high[visit]), sides.get(place, 0)):
            return place
    return None


def sidestep(
    wanted: Float64Array, low: Float64Array, high: Float64Array, near_low: Float64Array, near_high: Float64Array
) -> int | None:
    """Narrow the bounds of a line in place so that it passes an obstacle on one side, each time it comes by.

    Args:
        wanted: (N,) wanted offset to the left at each sample of the line, metres.
        low: (N,) lower bound of the offset; changed in place.
        high: (N,) upper bound; changed in place.
        near_low: (N,) lowest offset that the obstacle forbids, NaN where it is far.
        near_high: (N,) highest one.

    Returns:
        The first sample where neither side leaves room, or None.
    """
    for visit in _list_visits(near_low):
        if not _pass_one(wanted, low, high, visit, (near_low[visit], near_high[visit])):
            return int(visit[0])
    return None


def _pass_one(
    wanted: Float64Array, low: Float64Array, high: Float64Array, visit: Int64Array, forbidden: Span, side: int = 0
) -> bool:
    """Narrow the bounds at the samples (V,) of one visit, to a side (1 left, -1 right, 0 any); False without room."""
    near_low, near_high = forbidden
    if (near_low > high[visit]).all() or (near_high < low[visit]).all():
        return True
    shift_left = np.maximum(near_high - wanted[visit], 0.0).max()
    shift_right = np.maximum(wanted[visit] - near_low, 0.0).max()
    fits_left = side >= 0 and (near_high <= high[visit]).all()
    fits_right = side <= 0 and (near_low >= low[visit]).all()
    if fits_left and (shift_left <= shift_right or not fits_right):
        low[visit] = np.maximum(low[visit], near_high)
    elif fits_right:
        high[visit] = np.minimum(high[visit], near_low)
    else:
        return False
    return True


def find_boulders(
    world: World, scenario: Scenario, line: Float64Array, headings: Float64Array, width_m: float
) -> list[Span]:
    """Return the offsets that each loose stone too high to drive over forbids.

    Rays down find the stones: where a fixture lies more than 0.15 m above the bare floor.
    """
    if scenario.platform.kind == "quadrotor" or not world.fixtures:
        return []
    offsets = np.arange(-width_m / 2, width_m / 2 + _ACROSS_M, _ACROSS_M)
    places = np.repeat(line[:, None], len(offsets), axis=1)
    places[:, :, :2] += offsets[:, None] * left_of(headings)[:, None]
    places[:, :, 2] += PROBE_UP_M
    over, bare = (floor_heights(caster, places.reshape(-1, 3)) for caster in (world.fixed, world.walls))
    is_high = (over - bare > _STRADDLED_M).reshape(len(line), len(offsets))
    numbered, _ = ndimage.label(is_high, structure=np.ones((3, 3)))
    keep_m = scenario.platform.track_m / 2 + _BESIDE_WHEELS_M
    ahead = round((scenario.platform.wheelbase_m / 2 + _BESIDE_WHEELS_M) / STEP_M)
    found = []
    for along, across in ndimage.find_objects(numbered):
        low, high = np.full(len(line), np.nan), np.full(len(line), np.nan)
        stretch = slice(max(0, along.start - ahead), along.stop + ahead)
        low[stretch] = offsets[across.start] - keep_m
        high[stretch] = offsets[across.stop - 1] + keep_m
        found.append((low, high))
    return found


def check_clearance(world: World, scenario: Scenario, session: str, way_m: Float64Array, points: Float64Array) -> None:
    """Refuse a path whose sensor comes too near rock or furniture: level rays all round and one up, every 0.5 m.

    Raises:
        ScenarioError: With the place, its distance (N,) along the route and in the world (N, 3).
    """
    clearance_m = scenario.platform.clearance_m
    angle = np.arange(24) * (2 * np.pi / 24)
    level = np.stack([np.cos(angle), np.sin(angle), np.zeros(24)], axis=1)
    directions = np.concatenate([level, [[0.0, 0.0, 1.0]]])
    stations = points[:: round(0.5 / STEP_M)]
    gap_m, is_outside = measure_room(world.fixed, stations, directions)
    gap_m[is_outside] = 0.0
    worst = int(np.argmin(gap_m))
    if gap_m[worst] < _TIGHTEST_SHARE * clearance_m:
        x, y, z = stations[worst]
        raise ScenarioError(
            f"{session}: the sensor comes within {gap_m[worst]:.2f} m of rock or furniture "
            f"{way_m[worst * round(0.5 / STEP_M)]:.1f} m along the route, at ({x:.1f}, {y:.1f}, {z:.1f}): "
            "choose another lateral, start_m, end_m or height"
        )
