"""What stands on rock that moved: furniture and stones follow it, props are carried, scars and fill are kept free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from sim.displacement.displace import Displacement
from sim.furniture.furniture import Fixture
from sim.geometry.mesh import Mesh, drop_unused_vertices
from sim.geometry.raycast import Caster
from sim.placement.placing import Barred, Standing, floor_heights, standing_corners
from sim.rock.centreline import Centreline, left_of

FOLLOWED = {"convergence", "heave"}  # rock that moves as a body
COVERED = {"rubble", "fill", "face"}  # floor on which nothing stands or lies
BROKEN = {"scar"}
_REACH_M = 1.0  # from a piece of furniture to the rock that it follows
_PIECE_M = 1.0  # pieces up to this size move rigidly
_LONG_M = 4.0  # pieces up to this size are left out of scars; longer ones span them
_AT_SCAR_M, _DEEP_M = 0.3, 0.02
_LOW_M = 2.2  # rock below this height is near props
_GROWN_M = 0.15


def leave_out_broken(fixtures: Sequence[Fixture], displacement: Displacement) -> tuple[Fixture, ...]:
    """Return the fixtures of both sessions without the pieces at rock that falls out; long ones span the scar."""
    owned = displacement.owned_by(BROKEN) & (np.linalg.norm(displacement.shift(), axis=1) > _DEEP_M)
    rock = displacement.walls.before[owned]
    if not len(rock):
        return tuple(fixtures)
    left = []
    for fixture in fixtures:
        mesh = fixture.mesh
        is_near = _is_within(mesh.vertices, rock, _AT_SCAR_M)
        if not is_near.any():
            left.append(fixture)
            continue
        piece, size_m = _pieces(mesh)
        gone = np.zeros(len(size_m), dtype=bool)
        gone[piece[is_near]] = True
        gone &= size_m <= _LONG_M
        faces = mesh.faces[~gone[piece[mesh.faces[:, 0]]]]
        if len(faces):
            left.append(replace(fixture, mesh=drop_unused_vertices(mesh.vertices, faces)))
    return tuple(left)


def follow(fixtures: Sequence[Fixture], displacement: Displacement) -> tuple[Fixture, ...]:
    """Return the fixtures as they are in the after session; one that nothing moves is the same object.

    A vertex moves as the nearest rock within 1 m does where that converges or heaves, a piece of at most 1 m as a body.
    Shotcrete covers furniture, rubble and fill bury it.
    """
    is_followed = displacement.owned_by(FOLLOWED)
    places = displacement.walls.before
    shift = np.where(is_followed[:, None], displacement.shift(), 0.0)
    if not is_followed.any():
        return tuple(fixtures)
    near = np.flatnonzero(_is_within(places, places[is_followed], _REACH_M + 0.5))
    tree = cKDTree(places[near])
    done = []
    for fixture in fixtures:
        mesh = fixture.mesh
        apart_m, nearest = (np.asarray(each) for each in tree.query(mesh.vertices, distance_upper_bound=_REACH_M))
        found = np.isfinite(apart_m)
        moves = np.zeros_like(mesh.vertices)
        moves[found] = shift[near[nearest[found]]]
        if not moves.any():
            done.append(fixture)
            continue
        piece, size_m = _pieces(mesh)
        count = np.bincount(piece)
        mean = np.stack([np.bincount(piece, weights=moves[:, axis]) / count for axis in range(3)], axis=1)
        moves = np.where((size_m <= _PIECE_M)[piece, None], mean[piece], moves)
        done.append(replace(fixture, mesh=Mesh(mesh.vertices + moves, mesh.faces)))
    return tuple(done)


def carry(standing: Sequence[Standing], displacement: Displacement) -> list[Standing]:
    """Return the props with those on a floor that heaves as they stand in either session.

    A prop moves rigidly: up by the mean rise under its outline, and tilted by the plane that is nearest to the rise.
    """
    is_heaved = displacement.owned_by({"heave"})
    if not is_heaved.any():
        return list(standing)
    places, rise_m = displacement.walls.before, displacement.shift()[:, 2]
    tree = cKDTree(places)
    carried: list[Standing] = []
    for item in standing:
        under = _under(item)
        _, nearest = tree.query(under)
        rises_m = np.where(is_heaved[nearest], rise_m[nearest], 0.0)
        if "after" not in item.sessions or not rises_m.any():
            carried.append(item)
            continue
        middle = under[:, :2].mean(axis=0)
        design = np.column_stack([under[:, :2] - middle, np.ones(len(under))])
        slope_x, slope_y, up_m = np.linalg.lstsq(design, rises_m, rcond=None)[0]
        turn = Rotation.from_rotvec([slope_y, -slope_x, 0.0]).as_matrix()
        pivot = np.append(middle, under[:, 2].mean())
        pose = item.world_T_object.copy()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = pivot + turn @ (pose[:3, 3] - pivot) + [0.0, 0.0, up_m]
        after = replace(item, sessions=frozenset({"after"}), world_T_object=pose, is_carried=True)
        if "before" in item.sessions:
            carried.append(replace(item, sessions=frozenset({"before"})))
        carried.append(after)
    return carried


def barred_places(displacement: Displacement) -> tuple[Barred, ...]:
    """Return the places where no prop may stand, or on heaving floor only one that can be carried."""
    barred = []
    places, shift_m = displacement.walls.before, np.linalg.norm(displacement.shift(), axis=1)
    for patch in displacement.patches:
        own = np.flatnonzero((displacement.walls.owner == patch.number) & (shift_m > 1e-3))
        around = patch.zone.around(places[own])
        low = around.up_m < _LOW_M
        sides = [low] if patch.kind in COVERED | {"heave"} else [low & (around.left_m > 0), low & (around.left_m <= 0)]
        heading = patch.zone.line.headings[patch.zone.sample]
        frame = np.stack([heading, left_of(heading[None])[0]])
        for side in sides:
            if side.any():
                local = places[own[side], :2] @ frame.T
                (x0, y0), (x1, y1) = local.min(axis=0) - _GROWN_M, local.max(axis=0) + _GROWN_M
                corners = np.array([[x1, y1], [x0, y1], [x0, y0], [x1, y0]]) @ frame
                barred.append(Barred(patch.name, corners, patch.kind == "heave"))
    return tuple(barred)


def covered_outlines(displacement: Displacement) -> list[Float64Array]:
    """Return the outlines (4, 2) of rubble, fill and faces, where no stone lies."""
    names = {patch.name for patch in displacement.patches if patch.kind in COVERED}
    return [each.corners for each in barred_places(displacement) if each.name in names and not each.may_be_carried]


def rubble_points(displacement: Displacement, higher_m: float) -> list[tuple[str, Float64Array]]:
    """Return the places (N, 3) on each heap of rubble that lie higher than this above the old floor."""
    found = []
    for patch in displacement.patches:
        if patch.kind == "rubble":
            own = displacement.walls.owner == patch.number
            own &= displacement.shift()[:, 2] > higher_m
            found.append((patch.name, displacement.walls.after[own]))
    return found


def raise_centreline(centreline: Centreline, walls: Caster, displacement: Displacement) -> Centreline:
    """Return the centreline on the floor of the after session, where rock raised it."""
    is_raised = displacement.owned_by({"convergence", "heave", "shotcrete", "fill"})
    if not is_raised.any():
        return centreline
    tree = cKDTree(displacement.walls.before)
    rise_m = np.where(is_raised, displacement.shift()[:, 2], 0.0)
    drifts = []
    for line in centreline.drifts:
        middle = line.points + np.column_stack([np.zeros((len(line.points), 2)), line.height_m / 2])
        floor_m = floor_heights(walls, middle)
        floor = np.column_stack([line.points[:, :2], np.where(np.isfinite(floor_m), floor_m, line.points[:, 2])])
        _, nearest = tree.query(floor)
        up = np.column_stack([np.zeros((len(floor), 2)), rise_m[nearest]])
        drifts.append(replace(line, points=line.points + up))
    return replace(centreline, drifts=tuple(drifts))


def _under(item: Standing) -> Float64Array:
    """Return places (N, 3) over the outline of a prop, at its foot."""
    corners = standing_corners(item)
    share = np.linspace(0.0, 1.0, 5)
    u, v = (each.ravel() for each in np.meshgrid(share, share))
    flat = corners[0] + u[:, None] * (corners[1] - corners[0]) + v[:, None] * (corners[3] - corners[0])
    return np.column_stack([flat, np.full(len(flat), item.world_T_object[2, 3])])


def _pieces(mesh: Mesh) -> tuple[Int64Array, Float64Array]:
    """Return the piece of each vertex (N,) and the longest side (P,) of each piece's box."""
    links = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(len(mesh.vertices),) * 2)
    n_pieces, piece = connected_components(graph, directed=False)
    low, high = np.full((n_pieces, 3), np.inf), np.full((n_pieces, 3), -np.inf)
    np.minimum.at(low, piece, mesh.vertices)
    np.maximum.at(high, piece, mesh.vertices)
    return piece.astype(np.int64), np.asarray((high - low).max(axis=1))


def _is_within(places: Float64Array, others: Float64Array, within_m: float) -> BoolArray:
    is_in: BoolArray = ((places > others.min(axis=0) - within_m) & (places < others.max(axis=0) + within_m)).all(axis=1)
    near = np.flatnonzero(is_in)
    apart_m, _ = cKDTree(others).query(places[near], distance_upper_bound=within_m)
    is_in[near] = np.isfinite(apart_m)
    return is_in
