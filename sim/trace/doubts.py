"""What is odd about a mesh that is to be traced: scaled, turned, inside out, without roof or inside, in parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from scenarios.schema import MeshFile
from scenarios.schema.tunnel import FARTHEST_M
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.rock.foreign import UNIT_M
from sim.trace.middle import Middle

_WIDTH_M = (0.5, 60.0)
_LIKELY_WIDTH_M = (1.6, 8.0)  # between wall and wall, floor and roof together
_UPRIGHT_DEG = 20.0  # a face that far from level is part of a floor
_TURNED = 1.5  # times the floor that z has, that another axis must have
_ROOFLESS = 0.5  # of the line without a roof: an open pit
_PATCHY = 0.25
_SAMPLES = 2000


def is_inside_out(mesh: Mesh, caster: Caster) -> bool:
    """Tell whether faces more often see the back of other faces behind them than the front of others before them."""
    points, normals, reach_m = sample_faces(mesh)
    shares = []
    for sign in (1.0, -1.0):
        ways = sign * normals
        ranges_m, _, met = caster.hits(points + reach_m * ways, ways)
        facing = (met * ways).sum(axis=1) * sign
        shares.append(float((np.isfinite(ranges_m) & (facing < 0)).mean()))
    return shares[1] > shares[0]


def sample_faces(mesh: Mesh) -> tuple[Float64Array, Float64Array, float]:
    """Return middles (S, 3) and unit normals (S, 3) of faces spread evenly over the area, and a step off them."""
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    summed = np.cumsum(double_area)
    picked = np.searchsorted(summed, (np.arange(_SAMPLES) + 0.5) / _SAMPLES * summed[-1])
    step_m = max(1e-3, 2e-7 * float(np.ptp(mesh.vertices, axis=0).max()))
    return corners[picked].mean(axis=1), cross[picked] / double_area[picked, None], step_m


def typical_width_m(mesh: Mesh, caster: Caster) -> float:
    """Return the median distance from the surface to what it faces, metres; NaN where it faces nothing."""
    points, normals, step_m = sample_faces(mesh)
    ranges_m, _, _ = caster.cast(points + step_m * normals, normals)
    hit = ranges_m[np.isfinite(ranges_m)]
    return float(np.median(hit)) if len(hit) > len(points) // 10 else float("nan")


def judge_width(width_m: float, file: MeshFile, is_sure: bool) -> list[str]:
    """Refuse drifts of a width that no drift has; return a note where another unit is likelier.

    Args:
        width_m: Typical width, NaN where nothing is enclosed.
        file: The mesh.
        is_sure: Whether the units were named.

    Raises:
        ScenarioError: With the units in which the width would be likely.
    """
    if np.isnan(width_m):
        raise ScenarioError(
            f"{file.path}: no inside: its faces face no other faces: expected the walls of a tunnel, "
            "floor and roof with it"
        )
    raw = width_m / UNIT_M[file.units]
    likely = [unit for unit, scale in UNIT_M.items() if _LIKELY_WIDTH_M[0] <= raw * scale <= _LIKELY_WIDTH_M[1]]
    likely.sort(key=lambda unit: abs(np.log(raw * UNIT_M[unit] / 5.0)))
    units = " or ".join(f"--units {unit} ({raw * UNIT_M[unit]:.2g} m)" for unit in likely)
    told = f"{width_m:.3g} m across"
    if not _WIDTH_M[0] <= width_m <= _WIDTH_M[1]:
        expected = f"expected {_WIDTH_M[0]:g} to {_WIDTH_M[1]:g} m: scale the file"
        hint = f"is it in other units? give {units}" if units else expected
        if width_m < _WIDTH_M[0]:
            hint = f"of a lining with a thickness keep its inner surface only; else {hint}"
        raise ScenarioError(f"{file.path}: its drifts are {told}: {hint}")
    if file.units in likely or is_sure:
        return []
    return [f"its drifts are {told}: if that is not so, {f'give {units}' if units else 'scale the file'}"]


def refuse_far(mesh: Mesh, file: MeshFile) -> None:
    """Refuse a mesh that lies where the simulator loses millimetres, as in the coordinates of a map grid (UTM).

    Raises:
        ScenarioError: With the offset that brings it near the origin.
    """
    reach_m = float(np.abs(mesh.vertices).max())
    if reach_m <= FARTHEST_M:
        return
    middle_m = mesh.vertices.mean(axis=0)
    x, y, z = (f"{value:.0f}" for value in np.round(middle_m, -2) + 0.0)
    raise ScenarioError(
        f"{file.path}: lies {reach_m / 1000:.0f} km from the origin, where millimetres are lost: move it near the "
        f"origin: subtract ({x}, {y}, {z}) m (z up) from the coordinates of the mesh"
    )


def refuse_turned(mesh: Mesh, file: MeshFile, is_sure: bool) -> None:
    """Refuse a mesh whose floor faces along another axis than z, unless its axis was named.

    The faces within 20 degrees of level are compared: a floor is the largest such face, walls have every direction.
    The mesh must also reach less far along the other axis than along z.

    Raises:
        ScenarioError: With the axis that is likelier.
    """
    if is_sure:
        return
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    upright = np.abs(cross) > np.cos(np.deg2rad(_UPRIGHT_DEG)) * area[:, None]
    share = (np.where(upright, area[:, None], 0.0).sum(axis=0) / area.sum()).tolist()
    extent_m = np.ptp(mesh.vertices, axis=0)
    best = int(np.argmax(share[:2]))
    if share[best] > _TURNED * share[2] and extent_m[best] < extent_m[2]:
        # the axes of the world in those of the file, see `sim.rock.foreign`
        names = {"z": ("x", "y"), "y": ("x", "z"), "x": ("z", "y")}[file.up]
        raise ScenarioError(
            f"{file.path}: lies on its side, or is a shaft or a steep ramp, with {file.up} up: {share[best]:.0%} of "
            f"its faces face along {names[best]} and {share[2]:.0%} along {file.up}: give --up {names[best]}, or --up "
            f"{file.up} for a shaft or a ramp"
        )


def judge_roof(middles: Sequence[Middle], file: MeshFile) -> list[str]:
    """Refuse lines under the open sky; return a note where a part of them has no roof.

    Raises:
        ScenarioError: With the share of the lines that has no roof.
    """
    share = float(np.average([each.roofless for each in middles], weights=[len(each.points) for each in middles]))
    if share > _ROOFLESS:
        raise ScenarioError(
            f"{file.path}: no roof: above {share:.0%} of its middle line rays leave without a hit: an open pit or a "
            "surface without its roof: give a mesh with a roof, for a LiDAR sees the roof of a tunnel"
        )
    return [f"no roof above {share:.0%} of the line: close it, or the LiDAR sees through"] if share > _PATCHY else []


def tell_parts(parts: Sequence[Sequence[Middle]]) -> list[str]:
    """Return a note where the lines (each a part that meets no other, the longest first) are in several parts."""
    if len(parts) < 2:
        return []
    told = []
    for part in parts[1:]:
        x, y, z = (round(float(value)) for value in part[0].points[len(part[0].points) // 2])
        told.append(f"{sum(middle.length_m for middle in part):.0f} m about ({x}, {y}, {z})")
    more = f" and {len(told) - 3} more" if len(told) > 3 else ""
    return [
        f"{len(parts)} parts that do not meet: the route lies in the longest; also traced: {', '.join(told[:3])}"
        f"{more}: join them in the mesh if one can drive from one to the other"
    ]
