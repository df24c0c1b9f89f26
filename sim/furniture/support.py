"""Rock support: bolts with plates, and welded wire mesh between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from scenarios.schema import Bolts, Screen
from sim.furniture.shell import Shell
from sim.geometry.mesh import Mesh, drop_unused_vertices, join_meshes
from sim.geometry.sweep import EMPTY, repeat_body
from sim.rock.axis import find_nearest, wall_distances

BOLT_LOWEST_SHARE = 0.45  # of the drift's height: no bolts below
SCREEN_LOWEST_SHARE = 0.55
PLATE_M = 0.15
_RIM_M = 0.02  # the plate, and the wire mesh that it holds
_DOME_M = 0.035
STUB_M = 0.10  # how far a bolt sticks out
_STUB_RADIUS_M = 0.013
_JITTER_M = 0.06
_PANEL_M = (2.4, 2.4)  # along, across
_OVERLAP_M = 0.2
_WIRE_M = 0.006
SCREEN_STANDOFF_M = 0.03
_PINNED_M = 0.012
_PIN_REACH_M = 0.5
_SEGMENT_M = 0.3


def bolt_pins(shell: Shell, spacing_m: float, number: int, seed: int) -> Float64Array:
    """Return places (N, 2) for a drift's bolts on its shell, metres along and of arc: a square grid with jitter."""
    generator = stream(seed, "furniture", "bolts", str(number))
    half_arc_m = float(np.median(shell.half_arc_m))
    n_rows, n_across = round(shell.length_m / spacing_m), max(1, round(2 * half_arc_m / spacing_m))
    along_m = (np.arange(n_rows) + 0.5)[:, None] * spacing_m
    arc_m = (np.arange(n_across) - (n_across - 1) / 2)[None] * spacing_m
    jitter = np.clip(generator.normal(0.0, _JITTER_M, (2, n_rows, n_across)), -2 * _JITTER_M, 2 * _JITTER_M)
    along_m, arc_m = (along_m + jitter[0]).ravel(), (arc_m + jitter[1]).ravel()
    is_bare = shell.is_bare(along_m, shell.angles_at(along_m, arc_m))
    return np.column_stack([along_m, arc_m])[is_bare]


def bolt_mesh(shells: Sequence[Shell], pins: Sequence[Float64Array], bolts: Bolts) -> Mesh:
    """Return all bolts: a domed square plate flat on the rock, and a stub. Of two bolts that nearly meet one stays."""
    if not shells:
        return EMPTY
    found = [_seats(shell, pin) for shell, pin in zip(shells, pins, strict=True)]
    seats, normals = (np.concatenate([pair[k] for pair in found]) for k in (0, 1))
    if len(seats) == 0:
        return EMPTY
    close = cKDTree(seats).query_pairs(0.5 * bolts.spacing_m, output_type="ndarray")
    keep = np.ones(len(seats), dtype=bool)
    keep[close.max(axis=1)] = False
    return _bolts_at(seats[keep], normals[keep])


def screen_mesh(shells: Sequence[Shell], pins: Sequence[Float64Array], screen: Screen, seed: int) -> Mesh:
    """Return the wire mesh of all drifts; `pins` are the bolts that hold it."""
    parts = [
        _screen_of(shell, pin, screen, stream(seed, "furniture", "screen", str(number)))
        for number, (shell, pin) in enumerate(zip(shells, pins, strict=True))
    ]
    parts = [part for part in parts if len(part.faces)]
    return join_meshes(parts) if parts else EMPTY


def count_bolt_faces(bolts: Bolts, area_m2: float) -> float:
    """Return about how many triangles the bolts of an area of rock have."""
    return len(_BOLT_FACES) * area_m2 / bolts.spacing_m**2


def count_screen_faces(screen: Screen, area_m2: float) -> float:
    """Return about how many triangles the wire mesh over an area of rock has: four a segment, wires in two ways."""
    overlapping = 1.0 + _OVERLAP_M / _PANEL_M[0]
    segment_m = max(_SEGMENT_M, 2 * screen.opening_m)
    return 8 * screen.share * area_m2 * overlapping**2 / (screen.opening_m * segment_m)


def covered_rows(n_rows: int, share: float, generator: np.random.Generator) -> BoolArray:
    """Mark (n_rows,) rows of panels: the wanted share of them, in a few runs with gaps between."""
    n_covered = round(share * n_rows)
    n_runs = min(max(1, n_covered // 8), n_rows - n_covered + 1) if n_covered else 0
    if n_runs == 0:
        return np.zeros(n_rows, dtype=bool)
    runs = _parts_of(n_covered, n_runs, 1, generator)
    gaps = _parts_of(n_rows - n_covered - (n_runs - 1), n_runs + 1, 0, generator)
    gaps[1:-1] += 1  # two runs do not touch
    lengths = np.append(np.stack([gaps[:-1], runs], axis=1).ravel(), gaps[-1])
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)


def _parts_of(total: int, n: int, least: int, generator: np.random.Generator) -> Int64Array:
    """Split a whole number into n random parts of at least `least`."""
    cuts = np.sort(generator.integers(0, total - n * least + 1, size=n - 1))
    return np.asarray(np.diff(np.concatenate([[0], cuts, [total - n * least]])) + least, dtype=np.int64)


def _seats(shell: Shell, pins: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the middle of each plate's underside (N, 3) and its normal (N, 3) into the void, from five rays a bolt."""
    along_m, arc_m = pins.T
    angle = shell.angles_at(along_m, arc_m)
    eye, outwards = shell.rays_at(along_m, angle)
    first_m = wall_distances(shell.axis.walls, eye, outwards)
    aside = np.stack([outwards[:, 1], -outwards[:, 0], np.zeros(len(eye))], axis=1)
    flat = np.linalg.norm(aside, axis=1) < 0.1
    aside[flat] = (1.0, 0.0, 0.0)
    aside -= (aside * outwards).sum(axis=1, keepdims=True) * outwards
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(outwards, aside)
    start = eye + (first_m - 0.3)[:, None] * outwards
    half_m = PLATE_M / 2
    shifts = half_m * np.array([[0, 0], [1, 1], [-1, 1], [-1, -1], [1, -1]])
    origins = start[:, None] + shifts[None, :, :1] * aside[:, None] + shifts[None, :, 1:] * other[:, None]
    depth_m = wall_distances(shell.axis.walls, origins.reshape(-1, 3), np.repeat(outwards, 5, axis=0)).reshape(-1, 5)
    is_sound = (np.abs(depth_m - 0.3).max(axis=1) < 0.2) & (first_m > 0.6)
    tilt_a = (depth_m @ [0, 1, -1, -1, 1]) / (4 * half_m)
    tilt_b = (depth_m @ [0, 1, 1, -1, -1]) / (4 * half_m)
    normals = -outwards + tilt_a[:, None] * aside + tilt_b[:, None] * other
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    hits = origins + depth_m[..., None] * outwards[:, None]
    height_m = ((hits - hits[:, :1]) * normals[:, None]).sum(axis=2).max(axis=1)
    seats = hits[:, 0] + height_m[:, None] * normals
    return seats[is_sound], normals[is_sound]


def _bolts_at(seats: Float64Array, normals: Float64Array) -> Mesh:
    helper = np.where(np.abs(normals[:, 2:]) > 0.9, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    aside = np.cross(helper, normals)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(normals, aside)
    corners = PLATE_M / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    five = 2 * np.pi * np.arange(5) / 5
    ring = _STUB_RADIUS_M * np.stack([np.cos(five), np.sin(five)], axis=1)
    flat = np.concatenate([corners, corners, [[0, 0]], ring, ring])
    high = np.repeat([0.0, _RIM_M, _DOME_M, 0.5 * _DOME_M, STUB_M], [4, 4, 1, 5, 5])
    offsets = flat[None, :, :1] * aside[:, None] + flat[None, :, 1:] * other[:, None] + high[:, None] * normals[:, None]
    return repeat_body(seats[:, None] + offsets, _BOLT_FACES)


def _screen_of(shell: Shell, pins: Float64Array, screen: Screen, generator: np.random.Generator) -> Mesh:
    n_rows = int((shell.length_m - _OVERLAP_M) / _PANEL_M[0])
    rows = np.flatnonzero(covered_rows(n_rows, screen.share, generator)) if n_rows else np.empty(0, np.int64)
    if len(rows) == 0:
        return EMPTY
    half_arc_m = float(np.median(shell.half_arc_m))
    n_across = max(1, round(2 * half_arc_m / _PANEL_M[1]))
    long_m, wide_m = _PANEL_M[0] + _OVERLAP_M, (2 * half_arc_m + (n_across - 1) * _OVERLAP_M) / n_across
    row, column = (part.ravel() for part in np.meshgrid(rows, np.arange(n_across), indexing="ij"))
    start = 0.5 * (shell.length_m - n_rows * _PANEL_M[0] - _OVERLAP_M)
    low = np.stack([start + row * _PANEL_M[0], -half_arc_m + column * (wide_m - _OVERLAP_M)], axis=1)
    low += generator.uniform(-0.03, 0.03, low.shape)
    lift_m = np.where((row + column) % 2, 0.008, 0.0)  # where panels overlap, one lies on the other
    panels = (shell, pins, low, lift_m, long_m, wide_m, screen.opening_m)
    return join_meshes([_wire_mesh(*panels, is_along=True), _wire_mesh(*panels, is_along=False)])


def _wire_mesh(
    shell: Shell,
    pins: Float64Array,
    low: Float64Array,
    lift_m: Float64Array,
    long_m: float,
    wide_m: float,
    opening_m: float,
    is_along: bool,
) -> Mesh:
    """Return the wires of all panels (P) that run along the drift, or those that run across."""
    extent_m, pitch_m = (long_m, wide_m) if is_along else (wide_m, long_m)
    n_wires = int(pitch_m / opening_m) + 1
    n_knots = max(2, round(extent_m / max(_SEGMENT_M, 2 * opening_m)) + 1)
    knots = np.linspace(0.0, extent_m, n_knots)
    offsets = (np.arange(n_wires) - (n_wires - 1) / 2) * opening_m + pitch_m / 2
    local = np.stack(np.broadcast_arrays(knots[None], offsets[:, None]), axis=-1)
    places = low[:, None, None] + (local if is_along else local[..., ::-1])[None]
    along_m = places[..., 0]
    angle = shell.angles_at(along_m, places[..., 1])
    eye, outwards = shell.rays_at(along_m, angle)
    reach_m = _hung_at(shell, pins, places, angle) - lift_m[:, None, None]
    rock_m = wall_distances(shell.axis.walls, eye.reshape(-1, 3), outwards.reshape(-1, 3)).reshape(reach_m.shape)
    reach_m = np.minimum(reach_m, rock_m - _PINNED_M)
    middle = eye + reach_m[..., None] * outwards
    is_good = _is_in_sight(shell, eye, middle)
    is_bare = shell.is_bare(along_m, angle)
    length_m = np.linalg.norm(np.diff(middle, axis=2), axis=-1)
    is_good &= is_bare[..., :-1] & is_bare[..., 1:] & (length_m < 2.0 * extent_m / (n_knots - 1))
    tangent = np.gradient(middle, axis=2)
    aside = np.cross(tangent, outwards)
    aside *= 0.5 * _WIRE_M / np.maximum(np.linalg.norm(aside, axis=-1, keepdims=True), 1e-12)
    # Two of the three faces of a wire: the third looks at the rock.
    ribs = np.stack([middle + aside, middle - 0.8 * _WIRE_M * outwards, middle - aside], axis=-2)
    return _strips(ribs, is_good)


def _is_in_sight(shell: Shell, eye: Float64Array, middle: Float64Array) -> BoolArray:
    """Mark the segments (P, W, K-1) of wires (P, W, K, 3) whose middle no rock hides: the others are cut out."""
    start, end = ((part[:, :, :-1] + part[:, :, 1:]) / 2 for part in (eye, middle))
    length_m = np.linalg.norm(end - start, axis=-1)
    rays = (end - start) / length_m[..., None]
    rock_m = wall_distances(shell.axis.walls, start.reshape(-1, 3), rays.reshape(-1, 3)).reshape(length_m.shape)
    return np.asarray(rock_m > length_m - _PINNED_M)


def _hung_at(shell: Shell, pins: Float64Array, places: Float64Array, angle: Float64Array) -> Float64Array:
    """Distance from the eye of a screen that hangs taut between bolts and is pulled to the rock at each of them."""
    along_m = places[..., 0]
    taut_m = shell.radii_at(shell.taut_m, along_m, angle) - SCREEN_STANDOFF_M
    if len(pins) == 0:
        return taut_m
    distance_m, _ = find_nearest(pins, places.reshape(-1, 2), _PIN_REACH_M)
    pull = np.clip(1 - distance_m.reshape(along_m.shape) / _PIN_REACH_M, 0, 1)
    pull = pull**2 * (3 - 2 * pull)
    return np.asarray(taut_m + pull * (shell.radii_at(shell.rock_m, along_m, angle) - _PINNED_M - taut_m))


def _strips(ribs: Float64Array, is_good: BoolArray) -> Mesh:
    """Mesh of wires: ribs (P, W, K, 3, 3) of three corners at every knot, and which segments (P, W, K-1) there are."""
    n_knots = ribs.shape[2]
    first = np.arange(is_good[..., 0].size)[:, None] * n_knots + np.arange(n_knots - 1)
    here = 3 * first[is_good.reshape(first.shape)]
    pattern = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    faces = (here[:, None, None] + pattern).reshape(-1, 3)
    return drop_unused_vertices(ribs.reshape(-1, 3), faces)


def _bolt_faces() -> list[list[int]]:
    faces = []
    for k in range(4):
        n = (k + 1) % 4
        faces += [[k, n, 4 + n], [k, 4 + n, 4 + k], [4 + k, 4 + n, 8]]
    for k in range(5):
        n = (k + 1) % 5
        faces += [[9 + k, 9 + n, 14 + n], [9 + k, 14 + n, 14 + k]]
    return [*faces, [14, 15, 16], [14, 16, 17], [14, 17, 18]]


_BOLT_FACES = np.array(_bolt_faces())
