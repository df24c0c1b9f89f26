"""Where rock of a recording can move: on an even surface that both sessions saw well, clear of props and each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, make_pose, stream, transform
from scenarios.grafted import GraftScenario, RockChange
from sim.graft.rock.heights import Heights, cells_seen, fit_heights, list_corners
from sim.graft.rock.patch import MARGIN_M, Patch, make_patch
from sim.graft.surroundings import Surroundings
from sim.placement.placing import Standing, standing_box

TRIES = 200
_DRAWS = 2000  # of places, those on another side than the change asks for included
_FIRST_M = 0.5  # about a place, for its first normal
_LEAST_RETURNS = 12
_FAR_M = 0.5  # from a given place to the nearest return
_FLOOR_DEG = 30.0
_AROUND_M = 0.6  # above and below the plane, of what is looked at
_LEAST_ON = 0.9  # share of these returns, within the change, that lie on the surface
_NEAREST_M, _FARTHEST_M = 0.06, 0.15  # limits of how far off the surface a return may lie on it
_OFF = 4.0  # ... in standard deviations
_ROUGHEST_M = 0.05
_STEEPEST = 1.0  # slope of the surface against its plane, within the change
_CELL_M, _LEAST_CELLS = 0.25, 0.7
_FLATTEST_DEG = 70.0  # at which the nearest place of either path sees the middle
_APART_M = 0.3


class _UnfitError(Exception):
    """Why rock cannot move at a place."""


class _SideError(_UnfitError):
    """The place is on a floor and the change is not, or the reverse: another place costs little."""


def find_rock(
    scenario: GraftScenario, around: Surroundings, standing: Sequence[Standing], seed: int
) -> tuple[Patch, ...]:
    """Return every rock change of a scenario at its place, in the scenario's order.

    Raises:
        ScenarioError: One finds no place.
    """
    taken = [standing_box(item) for item in standing]
    found: dict[int, Patch] = {}
    # given places first, so that no drawn change takes one
    order = sorted(range(len(scenario.surface)), key=lambda index: scenario.surface[index].place.at is None)
    for index in order:
        patch = _find_place(index + 1, scenario.surface[index], around, taken, seed)
        taken.append(_box(patch.world_T_patch, patch.half_m))
        found[index] = patch
    return tuple(found[index] for index in range(len(found)))


def _find_place(
    number: int, change: RockChange, around: Surroundings, taken: Sequence[tuple[Float64Array, Float64Array]], seed: int
) -> Patch:
    reasons: dict[str, int] = {}
    n_left = TRIES
    for middle in _places(change, around, seed):
        try:
            return _fit(number, change, middle, around, taken)
        except _UnfitError as unfit:
            reasons[str(unfit)] = reasons.get(str(unfit), 0) + 1
            n_left -= not isinstance(unfit, _SideError)
        if n_left == 0:
            break
    if change.place.at is not None:
        why = next(iter(reasons))
        raise ScenarioError(f"surface {change.name!r} cannot be at place.at = {list(change.place.at)}: {why}")
    counted = sorted(reasons.items(), key=lambda each: -each[1])
    told = ", ".join(f"{count} times {why}" for why, count in counted) or "nothing was recorded within reach"
    raise ScenarioError(
        f"surface {change.name!r} finds no place in {sum(reasons.values())} tries ({told}): make it smaller, graft "
        "less, raise reach_m (--reach) of the recording, or give place.at"
    )


def _places(change: RockChange, around: Surroundings, seed: int) -> Iterator[Float64Array | None]:
    """Yield places (3,) on what was recorded; None for a given one where nothing is."""
    if change.place.at is not None:
        yield around.nearest(np.array(change.place.at), _FAR_M)
        return
    generator = stream(seed, "graft", change.name, "rock")
    for _ in range(_DRAWS if around.n_points else 0):
        yield around.points(generator.integers(around.n_points, size=1))[0]


def _fit(
    number: int,
    change: RockChange,
    middle: Float64Array | None,
    around: Surroundings,
    taken: Sequence[tuple[Float64Array, Float64Array]],
) -> Patch:
    """Return a patch about a place.

    Raises:
        _UnfitError: The rock there cannot be moved.
    """
    if middle is None:
        raise _UnfitError(f"nothing was recorded within {_FAR_M:g} m of it")
    normal = _normal(around.points(around.in_ball(middle, _FIRST_M)), middle, around)
    _refuse_side(change, normal)
    half_m = (change.sides_m[0] / 2, change.sides_m[1] / 2)
    rows = around.in_ball(middle, float(np.hypot(*half_m)) + 2 * MARGIN_M)
    pose = _pose(middle, normal, around)
    for _ in range(2):  # the plane of the whole change is not that of its middle
        local = transform(invert(pose), around.points(rows))
        near = local[(np.abs(local[:, :2]) < half_m).all(axis=1) & (np.abs(local[:, 2]) < _AROUND_M)]
        normal = _normal(transform(pose, near), middle, around)
        pose = _pose(middle, normal, around)
    _refuse_side(change, normal)
    _require_steep(pose, around)
    local, part = transform(invert(pose), around.points(rows)), around.part_of(rows)
    _require_seen(local, part, np.abs(local[:, 2]) < _AROUND_M, half_m)  # which is quicker told than the surface
    heights, tolerance_m = _require_even(local, half_m)
    _require_seen(local, part, np.abs(heights.off_m(local)[0]) <= tolerance_m, half_m)
    low, high = _box(pose, half_m)
    if any((low < other[1]).all() and (high > other[0]).all() for other in taken):
        raise _UnfitError("a prop or another change is there")
    return make_patch(number, change, pose, heights, tolerance_m)


def _normal(points: Float64Array, middle: Float64Array, around: Surroundings) -> Float64Array:
    """Return the unit normal (3,) of the plane through points (N, 3), towards the nearest place of the path."""
    if len(points) < _LEAST_RETURNS:
        raise _UnfitError("few returns are there")
    off = points - points.mean(axis=0)
    normal = np.linalg.eigh(off.T @ off)[1][:, 0]
    nearest = around.path[np.linalg.norm(around.path - middle, axis=1).argmin()]
    return np.asarray(normal if normal @ (nearest - middle) > 0 else -normal)


def _refuse_side(change: RockChange, normal: Float64Array) -> None:
    is_floor = normal[2] > np.cos(np.deg2rad(_FLOOR_DEG))
    if is_floor != (change.kind == "heave"):
        raise _SideError("it is a floor, which heaves" if is_floor else "it is no floor")


def _pose(middle: Float64Array, normal: Float64Array, around: Surroundings) -> Float64Array:
    """Return the pose (4, 4): z the normal; x level on a wall, and along the path nearby on roof and floor."""
    if abs(normal[2]) < np.sqrt(0.5):
        along = np.cross([0.0, 0.0, 1.0], normal)
    else:
        near = around.path[np.linalg.norm(around.path - middle, axis=1).argsort()[:20], :2]
        off = near - near.mean(axis=0)
        is_driven = np.ptp(off, axis=0).max() > 0.5
        along = np.append(np.linalg.eigh(off.T @ off)[1][:, 1], 0.0) if is_driven else np.eye(3)[0]
        along = along - normal * (along @ normal)
    along = np.asarray(along / np.linalg.norm(along))
    return np.round(make_pose(np.column_stack([along, np.cross(normal, along), normal]), middle), 9)


def _require_even(local: Float64Array, half_m: tuple[float, float]) -> tuple[Heights, float]:
    """Return the surface through points (N, 3), frame `patch`, and how far off it a return may lie on it."""
    grown_m = half_m[0] + MARGIN_M, half_m[1] + MARGIN_M
    heights = fit_heights(local[(np.abs(local[:, :2]) < np.array(grown_m) + MARGIN_M).all(axis=1)], grown_m)
    if heights is None:
        raise _UnfitError("few returns are there")
    inside = local[(np.abs(local[:, :2]) < half_m).all(axis=1)]
    off_m = heights.off_m(inside)[0]
    off_m = off_m[np.abs(off_m) < _AROUND_M]
    if len(off_m) < _LEAST_RETURNS:
        raise _UnfitError("few returns are there")
    rough_m = 1.4826 * float(np.median(np.abs(off_m)))
    tolerance_m = float(np.clip(_OFF * rough_m, _NEAREST_M, _FARTHEST_M))
    if rough_m > _ROUGHEST_M or np.mean(np.abs(off_m) <= tolerance_m) < _LEAST_ON:
        raise _UnfitError("it is no even surface")
    steepest = np.linalg.norm(heights.slopes(np.array(list(list_corners(half_m)))), axis=1).max()
    if max(steepest, np.linalg.norm(heights.slopes(inside[:, :2]), axis=1).max()) > _STEEPEST:
        raise _UnfitError("it is bent too much")
    return heights, round(tolerance_m, 4)


def _require_seen(local: Float64Array, part: Int64Array, is_rock: BoolArray, half_m: tuple[float, float]) -> None:
    """Refuse a change of which either session saw less than 70 % of the cells of 0.25 m, by points (N, 3) on rock."""
    is_on = is_rock & (np.abs(local[:, :2]) < half_m).all(axis=1)
    for number in range(2):
        if cells_seen(local[is_on & (part == number), :2], half_m, _CELL_M).mean() < _LEAST_CELLS:
            raise _UnfitError("one session saw too little of it")


def _require_steep(world_T_patch: Float64Array, around: Surroundings) -> None:
    """Refuse rock that the nearest place of either path sees too flat, or from behind."""
    for path in around.paths:
        off = path - world_T_patch[:3, 3]
        nearest = off[np.linalg.norm(off, axis=1).argmin()]
        if nearest @ world_T_patch[:3, 2] < np.cos(np.deg2rad(_FLATTEST_DEG)) * np.linalg.norm(nearest):
            raise _UnfitError("it is seen too flat")


def _box(world_T_patch: Float64Array, half_m: tuple[float, float]) -> tuple[Float64Array, Float64Array]:
    """Return the low and the high corner (3,) of the room about a patch that others keep clear of, world frame."""
    every = [(u, v, w) for u, v in list_corners(half_m) for w in (-_APART_M, _APART_M)]
    points = transform(world_T_patch, np.array(every))
    return points.min(axis=0) - _APART_M, points.max(axis=0) + _APART_M
