"""Props, the objects in a tunnel: the builder of each kind, and the measures of the finished shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import make_pose, stream
from scenarios.schema import Prop
from sim.geometry.mesh import move_mesh
from sim.geometry.topology import closed_volume_m3
from sim.props import equipment, storage
from sim.props.heap import build_heap, column_volume_m3, load_away, whole_mesh
from sim.props.parts import surface
from sim.props.rocks import rock_mesh
from sim.props.shapes import Shape, Size, Solid, hull_volume_m3, signed_volume_m3
from sim.props.vehicle import vehicle
from sim.rock.foreign import prop_mesh

_ROCK_SUBDIVISIONS = 2
_CARDBOARD_M = 0.75  # larger boxes are of steel
_USED = {"box": 3, "cylinder": 2, "mesh": 0}  # how many of the sizes of a solid say something
_THINNEST_M = 2e-4  # half of the thinnest part: MuJoCo gives no inertia to what is thinner
BUILDERS = {
    "crate": storage.crate,
    "barrel": storage.barrel,
    "pallet": storage.pallet,
    "chair": equipment.chair,
    "trolley": equipment.trolley,
    "cone": equipment.cone,
    "railing": equipment.railing,
    "vehicle": vehicle,
}


def shape_of(prop: Prop, seed: int, *, is_banked: bool = False, loaded_share: float | None = None) -> Shape:
    """Return the shape of a prop.

    Args:
        prop: The prop.
        seed: Of the scenario; seed and name of the prop draw its irregular parts.
        is_banked: Whether a muck pile lies against a wall at y = +width/2 and continues behind it.
        loaded_share: Share of a muck pile's volume that has been removed; None for a whole pile.

    Raises:
        ScenarioError: The file of a mesh cannot be used, or the size leaves no room for a part.
    """
    try:
        with np.errstate(divide="ignore", invalid="ignore"):  # a part without a length is refused below
            shape = _build(prop, seed, is_banked=is_banked, loaded_share=loaded_share)
    except ValueError as error:
        raise ScenarioError(f"{_told(prop)}: cannot be built: {error}") from error
    if any(min(solid.size_m[: _USED[solid.kind]], default=1.0) < _THINNEST_M for solid in shape.solids):
        raise ScenarioError(f"{_told(prop)}: leaves no room for its parts: make it larger")
    return shape


def _told(prop: Prop) -> str:
    return f"props.{prop.name}.size_m = {list(prop.size_m or ())}"


def _build(prop: Prop, seed: int, *, is_banked: bool, loaded_share: float | None) -> Shape:
    if prop.mesh is not None:
        mesh = prop_mesh(prop.mesh, prop.name)
        size = np.ptp(mesh.vertices, axis=0)
        solids: tuple[Solid, ...] = (surface(mesh, "paint"),)
        return _shape(solids, (float(size[0]), float(size[1]), float(size[2])), closed_volume_m3(mesh))
    if prop.size_m is None:
        raise ValueError(f"prop {prop.name!r} has neither size_m nor mesh")
    if prop.kind == "muck_pile":
        return _pile(prop, prop.size_m, seed, is_banked, loaded_share)
    if prop.kind == "box":
        solids = storage.box(prop.size_m, is_cardboard=max(prop.size_m) <= _CARDBOARD_M)
        return _shape(solids, prop.size_m, float(sum(8.0 * np.prod(solid.size_m) for solid in solids)))
    if prop.kind == "rock":
        key = int(stream(seed, "props", prop.name, "rock").integers(2**31))
        pose = make_pose(translation=(0, 0, prop.size_m[2] / 2))
        rock = move_mesh(rock_mesh(prop.size_m, key, _ROCK_SUBDIVISIONS), pose)
        return _shape((surface(rock, "rock"),), prop.size_m, signed_volume_m3(rock))
    shape = _shape(BUILDERS[prop.kind](prop.size_m), prop.size_m, None)
    return replace(shape, is_settled=False) if prop.kind == "railing" else shape


def _shape(solids: tuple[Solid, ...], size_m: Size, volume_m3: float | None) -> Shape:
    return Shape(solids, size_m, True, hull_volume_m3(solids), volume_m3)


def _pile(prop: Prop, size_m: Size, seed: int, is_banked: bool, loaded_share: float | None) -> Shape:
    heap = build_heap(size_m, prop.repose_deg, prop.fragment_m, is_banked, seed, prop.name)
    if loaded_share is not None:
        heap = load_away(heap, loaded_share, prop.fragment_m, seed, prop.name)
    mesh = whole_mesh(heap)
    solids = (surface(mesh, "rock"),)
    length, width, _ = heap.size_m
    hull_m3 = hull_volume_m3(solids, width / 2 if is_banked else np.inf)
    height = float(mesh.vertices[:, 2].max())
    return Shape(solids, (length, width, height), False, hull_m3, column_volume_m3(mesh, heap.size_m))
