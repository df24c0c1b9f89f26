"""Pipes, ventilation ducts, cable trays and markers along the walls and below the roof of every drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpipe.core.geometry import Float64Array, make_pose, stream
from scenarios.schema import CableTray, Duct, Furniture, Markers, Pipe
from sim.furniture.wall_line import Cross, Line, WallPlan, roof_lines, stack_plans, wall_lines
from sim.geometry.mesh import Mesh, box_mesh, join_meshes, move_mesh
from sim.geometry.sweep import EMPTY, bars, circle, frames_along, sweep
from sim.rock.axis import STATION_M, UP, Axis, wall_distances

FIXING_M = 0.05  # how deep brackets and hangers reach into the rock
_PIPE_STANDOFF_M = 0.08
_DUCT_STANDOFF_M = 0.10
_TRAY_STANDOFF_M = 0.05
DUCT_LOWEST_M = 1.6
_PLATE_STANDOFF_M, _PLATE_M = 0.03, 0.005
_TRAY_HALF_HEIGHT_M = 0.05
_SHEET_M = 0.006
_COUPLING_M = 6.0
_HANGER_M = 2.5
_LONGEST_ARM_M = 0.9
_STRAIGHT_M = 0.004


def wall_plans(furniture: Furniture) -> list[WallPlan]:
    """Return the plans of all pipes, then of all trays, with their heights over openings."""
    pipes, trays = furniture.pipes, furniture.cable_trays
    items: list[Pipe | CableTray] = [*pipes, *trays]
    crosses = [Cross(pipe.diameter_m / 2, pipe.diameter_m / 2, _PIPE_STANDOFF_M) for pipe in pipes]
    crosses += [Cross(tray.width_m / 2, _TRAY_HALF_HEIGHT_M, _TRAY_STANDOFF_M) for tray in trays]
    return stack_plans(
        [
            WallPlan(1.0 if item.side == "left" else -1.0, item.height_share, cross)
            for item, cross in zip(items, crosses, strict=True)
        ]
    )


def pipe_meshes(axes: Sequence[Axis], pipe: Pipe, plan: WallPlan) -> tuple[Mesh, Mesh]:
    """Return a pipe with its couplings, and its brackets, in all drifts."""
    radius_m = pipe.diameter_m / 2
    tubes, brackets = [], []
    for axis in axes:
        for line in wall_lines(axis, plan):
            tubes.append(sweep(thin_path(line.path), circle(radius_m, 10)))
            tubes.extend(_couplings(line, radius_m))
            brackets.append(_wall_arms(axis, line, plan, every_m=3.0, width_m=0.05))
    return _join(tubes), _join(brackets)


def duct_meshes(axes: Sequence[Axis], duct: Duct, name: str, seed: int) -> tuple[Mesh, Mesh]:
    """Return a flexible duct, which sags between its hangers and has ribs, and the hangers, in all drifts."""
    radius_m = duct.diameter_m / 2
    cross = Cross(radius_m, radius_m, _DUCT_STANDOFF_M)
    tubes, hangers = [], []
    for number, axis in enumerate(axes):
        generator = stream(seed, "furniture", name, str(number))
        for line in roof_lines(axis, duct.lateral, cross, DUCT_LOWEST_M):
            every = round(_HANGER_M / STATION_M)
            phase = (np.arange(len(line.path)) % every) / every
            sags_m = generator.uniform(0.02, 0.08, size=len(line.path) // every + 1)
            depth_m = sags_m[np.arange(len(line.path)) // every]
            path = line.path - np.column_stack([np.zeros((len(phase), 2)), 4 * depth_m * phase * (1 - phase)])
            ribs = np.where(np.arange(len(path)) % 2, 0.97, 1.0) * generator.uniform(0.985, 1.0, len(path))
            tubes.append(sweep(path, circle(radius_m, 12), ribs))
            left = line.left[::every]
            hangers += [_wires(axis, path[::every] + shift * radius_m * left) for shift in (-0.85, 0.85)]
    return _join(tubes), _join(hangers)


def tray_meshes(axes: Sequence[Axis], tray: CableTray, plan: WallPlan, name: str, seed: int) -> tuple[Mesh, Mesh, Mesh]:
    """Return a U-shaped tray, its brackets, and the cables that lie in it, in all drifts."""
    trays, brackets, cables = [], [], []
    for number, axis in enumerate(axes):
        generator = stream(seed, "furniture", name, str(number))
        for line in wall_lines(axis, plan):
            path = thin_path(line.path)
            trays.append(sweep(path, _u_profile(tray.width_m, 2 * _TRAY_HALF_HEIGHT_M), is_capped=False))
            brackets.append(_wall_arms(axis, line, plan, every_m=1.5, width_m=0.04))
            cables.extend(_cables(path, tray.width_m, generator))
    return _join(trays), _join(brackets), _join(cables)


def marker_mesh(axes: Sequence[Axis], markers: Markers) -> Mesh:
    """Return plates flat along one wall of every drift, 5 mm thick, where the wall is at hand."""
    half_m, side = markers.size_m / 2, 1.0 if markers.side == "left" else -1.0
    plan = WallPlan(side, markers.height_share, Cross(_PLATE_M / 2, half_m, _PLATE_STANDOFF_M))
    plates = []
    for axis in axes:
        for line in wall_lines(axis, plan):
            left, up = frames_along(line.path)
            for middle in range(2, len(line.path) - 2, round(markers.every_m / STATION_M)):
                forward = np.cross(left[middle], up[middle])
                pose = make_pose(np.column_stack([forward, left[middle], up[middle]]), line.path[middle])
                plates.append(move_mesh(box_mesh((half_m, _PLATE_M / 2, half_m)), pose))
    return _join(plates)


def thin_path(path: Float64Array) -> Float64Array:
    """Drop every second point where a path is nearly straight; both ends stay."""
    if len(path) < 4:
        return path
    bend_m = np.linalg.norm(path[1:-1] - (path[:-2] + path[2:]) / 2, axis=1)
    keep = np.ones(len(path), dtype=bool)
    keep[1:-1] = (np.arange(1, len(path) - 1) % 2 == 0) | (bend_m > _STRAIGHT_M)
    return path[keep]


def _couplings(line: Line, radius_m: float) -> list[Mesh]:
    collars = []
    for middle in range(3, len(line.path) - 2, round(_COUPLING_M / STATION_M)):
        along = line.path[middle + 1] - line.path[middle - 1]
        along *= 0.06 / np.linalg.norm(along)
        ends = np.stack([line.path[middle] - along, line.path[middle] + along])
        collars.append(sweep(ends, circle(1.2 * radius_m + 0.005, 10)))
    return collars


def _wall_arms(axis: Axis, line: Line, plan: WallPlan, every_m: float, width_m: float) -> Mesh:
    """Return bars from the rock to below a line; where the rock is too far, wires from the roof."""
    chosen = np.arange(2, len(line.path) - 1, round(every_m / STATION_M))
    below = np.array([0.0, 0.0, plan.cross.half_height_m + 0.5 * width_m])
    inner = line.path[chosen] - below - plan.side * plan.cross.half_width_m * line.left[chosen]
    outwards = plan.side * line.left[chosen]
    reach_m = wall_distances(axis.walls, inner, outwards)
    is_arm = reach_m < _LONGEST_ARM_M + 2 * plan.cross.half_width_m
    arms = bars(inner[is_arm], (inner + (reach_m + FIXING_M)[:, None] * outwards)[is_arm], width_m)
    hung = line.path[chosen][~is_arm]
    return join_meshes([arms, _wires(axis, hung)])


def _wires(axis: Axis, points: Float64Array) -> Mesh:
    if len(points) == 0:
        return EMPTY
    reach_m = wall_distances(axis.walls, points, UP)
    is_near = reach_m < 3.0
    return bars(points[is_near], (points + (reach_m + FIXING_M)[:, None] * UP)[is_near], 0.012)


def _u_profile(width_m: float, height_m: float) -> Float64Array:
    w, h, t = width_m / 2, height_m / 2, _SHEET_M
    return np.array([[w, -h], [w, h], [w - t, h], [w - t, t - h], [t - w, t - h], [t - w, h], [-w, h], [-w, -h]])


def _cables(path: Float64Array, width_m: float, generator: np.random.Generator) -> list[Mesh]:
    """Return one to four cables side by side on the bottom of the tray, with a slight wander."""
    radii_m = generator.uniform(0.015, 0.035, size=max(1, min(4, int(width_m / 0.09))))
    left, up = frames_along(path)
    free_m = width_m - 2 * _SHEET_M
    slots = (np.arange(len(radii_m)) + 0.5) / len(radii_m) - 0.5
    cables = []
    for slot, radius_m in zip(slots, radii_m, strict=True):
        room_m = max(free_m / len(radii_m) / 2 - radius_m, 0.0)
        knots = np.arange(0, len(path) + 6, 6)
        wander_m = room_m * np.interp(np.arange(len(path)), knots, generator.uniform(-1.0, 1.0, len(knots)))
        bottom_m = radius_m + _SHEET_M - _TRAY_HALF_HEIGHT_M
        cables.append(sweep(path + (slot * free_m + wander_m)[:, None] * left + bottom_m * up, circle(radius_m, 5)))
    return cables


def _join(meshes: Sequence[Mesh]) -> Mesh:
    return join_meshes(list(meshes)) if meshes else EMPTY
