"""Every kind of prop: its bounding box, its volumes, what it is made of, and where one can look through it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh

from cdpipe.core.errors import ScenarioError
from scenarios.schema import MeshFile, Prop, PropKind
from sim.geometry.mesh import box_mesh, join_meshes, move_mesh
from sim.geometry.raycast import Caster
from sim.geometry.topology import edges_of
from sim.materials import REFLECTIVITY
from sim.props.parts import beam, block, revolve, surface
from sim.props.props import shape_of
from sim.props.shapes import Shape, hull_volume_m3, signed_volume_m3, solid_mesh, visible_part
from sim.view import gallery

SIZES = {
    "box": (0.8, 0.6, 0.5),
    "crate": (1.2, 0.8, 0.9),
    "chair": (0.5, 0.45, 0.9),
    "trolley": (0.6, 0.55, 1.2),
    "barrel": (0.58, 0.58, 0.88),
    "cone": (0.4, 0.36, 0.75),
    "railing": (3.6, 0.1, 1.1),
    "pallet": (1.2, 0.8, 0.144),
    "rock": (1.1, 0.9, 0.7),
    "vehicle": (4.8, 1.95, 1.9),
    "muck_pile": (4.0, 3.0, 0.9),
}
MATERIALS = {
    "box": {"paint"},
    "crate": {"wood"},
    "chair": {"steel", "fabric"},
    "trolley": {"steel", "rubber", "paint"},
    "barrel": {"paint", "steel"},
    "cone": {"rubber", "plastic", "reflector"},
    "railing": {"steel", "paint"},
    "pallet": {"wood"},
    "rock": {"rock"},
    "vehicle": {"steel", "rubber", "paint", "plastic", "glass", "reflector"},
    "muck_pile": {"rock"},
}


def visible_extent(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    corners = visible_part(join_meshes([solid_mesh(solid) for solid in shape.solids])).reshape(-1, 3)
    return corners.min(axis=0), corners.max(axis=0)


def test_every_kind_is_tested() -> None:
    kinds = set(get_args(PropKind)) - {"mesh"}
    assert set(SIZES) == set(MATERIALS) == set(gallery.SIZES) == kinds
    listed = (Path(__file__).parents[3] / "scenarios" / "README.md").read_text().partition("\nKinds: ")[2]
    assert all(kind in listed.partition(".")[0] for kind in kinds)


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.4, 1.2, 0.8)])
@pytest.mark.parametrize("kind", [kind for kind in SIZES if kind != "muck_pile"])
def test_a_prop_fills_its_bounding_box_above_the_floor(
    kind: str, scale: tuple[float, float, float], make_prop: Callable[..., Prop]
) -> None:
    size = tuple(side * share for side, share in zip(SIZES[kind], scale, strict=True))
    shape = shape_of(make_prop("it", kind=kind, size_m=size), seed=0)
    low, high = visible_extent(shape)
    np.testing.assert_allclose(high, [size[0] / 2, size[1] / 2, size[2]], atol=1e-9)
    np.testing.assert_allclose(low, [-size[0] / 2, -size[1] / 2, 0.0], atol=1e-9)
    assert shape.size_m == size
    assert shape.is_settled == (kind != "railing")


@pytest.mark.parametrize("kind", SIZES)
def test_parts_are_closed_face_outwards_and_are_made_of_something(kind: str, make_prop: Callable[..., Prop]) -> None:
    shape = shape_of(make_prop("it", kind=kind, size_m=SIZES[kind]), seed=0)
    for solid in shape.solids:
        mesh = solid_mesh(solid)
        assert edges_of(mesh).is_closed
        assert signed_volume_m3(mesh) > 0
    assert {solid.material for solid in shape.solids} == MATERIALS[kind] <= set(REFLECTIVITY)


def test_volumes_of_a_box(make_prop: Callable[..., Prop]) -> None:
    shape = shape_of(make_prop("it", size_m=(0.8, 0.6, 0.5)), 0)
    assert shape.hull_volume_m3 == pytest.approx(0.24)
    # The lid's groove is 3 % of the height, and 1.5 % of 0.6 m deep on every side.
    assert shape.mesh_volume_m3 == pytest.approx(0.24 - 0.015 * (0.8 * 0.6 - (0.8 - 0.018) * (0.6 - 0.018)))


@pytest.mark.parametrize(
    ("kind", "size_m"),
    [("crate", (5, 5, 0.01)), ("crate", (0.03, 0.3, 0.3)), ("trolley", (0.6, 0.05, 0.9)), ("chair", (1e-3,) * 3),
     ("muck_pile", (0.2, 0.2, 0.1))],
)  # fmt: skip
def test_a_size_without_room_for_the_parts_is_refused(
    kind: str, size_m: tuple[float, float, float], make_prop: Callable[..., Prop]
) -> None:
    with pytest.raises(ScenarioError, match=r"^props\.it\.size_m = \[.*\]: (leaves no room|cannot be built)"):
        shape_of(make_prop("it", kind=kind, size_m=size_m), 0)


def test_a_small_box_is_of_cardboard(make_prop: Callable[..., Prop]) -> None:
    assert {solid.material for solid in shape_of(make_prop("it", size_m=(0.6, 0.5, 0.4)), 0).solids} == {"paper"}


def test_volumes_of_a_rock(make_prop: Callable[..., Prop]) -> None:
    shape = shape_of(make_prop("it", kind="rock", size_m=(1.1, 0.9, 0.7)), 0)
    mesh = solid_mesh(shape.solids[0])
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert shape.mesh_volume_m3 == pytest.approx(solid.volume)
    assert shape.hull_volume_m3 == pytest.approx(solid.convex_hull.volume)


@pytest.mark.parametrize("kind", ["crate", "chair", "trolley", "cone", "railing", "pallet", "vehicle"])
def test_a_prop_of_several_parts_has_a_hull_only(kind: str, make_prop: Callable[..., Prop]) -> None:
    shape = shape_of(make_prop("it", kind=kind, size_m=SIZES[kind]), 0)
    assert shape.mesh_volume_m3 is None
    assert 0.2 * np.prod(SIZES[kind]) < shape.hull_volume_m3 <= np.prod(SIZES[kind]) * (1 + 1e-9)


@pytest.mark.parametrize("is_open", [False, True])
def test_a_foreign_mesh_brings_its_size_and_its_volume_if_closed(
    is_open: bool, tmp_path: Path, make_prop: Callable[..., Prop]
) -> None:
    cube = trimesh.creation.box(extents=(1.0, 0.6, 0.4))
    if is_open:
        cube = trimesh.Trimesh(cube.vertices, cube.faces[:-1], process=False)
    cube.export(tmp_path / "cube.stl")
    prop = make_prop("it", kind="mesh", size_m=None, mesh=MeshFile(path=str(tmp_path / "cube.stl")))
    shape = shape_of(prop, 0)
    np.testing.assert_allclose(shape.size_m, (1.0, 0.6, 0.4), atol=1e-6)
    assert shape.hull_volume_m3 == pytest.approx(0.24, rel=1e-5)
    assert shape.mesh_volume_m3 == (None if is_open else pytest.approx(0.24, rel=1e-5))
    assert visible_extent(shape)[0][2] == pytest.approx(0.0, abs=1e-6)


def looked_through(shape: Shape, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> bool:
    ranges_m, _, _ = Caster([solid_mesh(solid) for solid in shape.solids]).cast(
        np.array([origin]), np.array([direction])
    )
    return bool(np.isinf(ranges_m[0]))


@pytest.mark.parametrize(
    ("kind", "origin", "direction", "expected"),
    [
        ("pallet", (-2.0, 0.2, 0.06), (1, 0, 0), True),  # where a fork goes in
        ("pallet", (-2.0, 0.0, 0.06), (1, 0, 0), False),  # the middle blocks
        ("chair", (0.0, -2.0, 0.35), (0, 1, 0), True),  # below the seat
        ("chair", (-2.0, 0.0, 0.8), (1, 0, 0), False),  # the back rest
        ("trolley", (-2.0, 0.1, 1.0), (1, 0, 0), True),  # between the rails
        ("railing", (0.5, -2.0, 0.9), (0, 1, 0), True),  # between the upper rails
        ("railing", (0.5, -2.0, 0.1), (0, 1, 0), False),  # the toe board
        ("vehicle", (-0.1, -3.0, 0.2), (0, 1, 0), True),  # below the sill
        ("vehicle", (0.2, -3.0, 1.4), (0, 1, 0), False),  # a pane of the cab
    ],
)
def test_where_one_looks_through_a_prop(
    kind: str,
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    expected: bool,
    make_prop: Callable[..., Prop],
) -> None:
    shape = shape_of(make_prop("it", kind=kind, size_m=SIZES[kind]), 0)
    assert looked_through(shape, origin, direction) == expected


def test_pallets_are_stacked_to_the_height(make_prop: Callable[..., Prop]) -> None:
    one, three = (shape_of(make_prop("it", kind="pallet", size_m=(1.2, 0.8, h)), 0) for h in (0.144, 0.432))
    assert len(three.solids) == 3 * len(one.solids)


@pytest.mark.parametrize("kind", ["rock", "muck_pile"])
def test_seed_and_name_draw_what_is_irregular(kind: str, make_prop: Callable[..., Prop]) -> None:
    meshes = [
        solid_mesh(shape_of(make_prop(name, kind=kind, size_m=(2.0, 1.6, 0.5)), seed).solids[0]).vertices
        for name, seed in (("p", 1), ("p", 1), ("p", 2), ("q", 1))
    ]
    np.testing.assert_array_equal(meshes[0], meshes[1])
    for other in meshes[2:]:
        assert other.shape != meshes[0].shape or np.abs(meshes[0] - other).max() > 0.02


def test_a_hull_counts_only_what_is_above_the_floor_and_before_the_plane() -> None:
    # A box of 2 x 2 x 1 m half below the floor; before y = 0.25 lie 0.75 m of its width from -0.5 to 1.5.
    solids = [block((-1.0, -0.5, -0.5), (1.0, 1.5, 0.5), "steel")]
    assert hull_volume_m3(solids) == pytest.approx(2.0)
    assert hull_volume_m3(solids, back_y_m=0.25) == pytest.approx(0.75)


def test_cutting_keeps_the_area_of_what_is_left() -> None:
    tilted = move_mesh(box_mesh((0.5, 0.5, 0.5)), beam((0, 0, 0), (1, 2, 3), 1, 1, "steel").object_T_solid)
    cut = visible_part(tilted, back_y_m=0.3)
    area = 0.5 * np.linalg.norm(np.cross(cut[:, 1] - cut[:, 0], cut[:, 2] - cut[:, 0]), axis=1).sum()
    solid = trimesh.Trimesh(tilted.vertices, tilted.faces).subdivide_loop(0)
    for _ in range(6):
        solid = solid.subdivide()
    middles = solid.triangles_center
    is_left = (middles[:, 2] > 0) & (middles[:, 1] < 0.3)
    assert area == pytest.approx(solid.area_faces[is_left].sum(), rel=0.02)


def test_a_turned_cone_has_the_volume_of_its_polygon() -> None:
    mesh = revolve([(0.0, 0.0), (1.0, 0.0), (0.0, 1.5)], 2.0, 2.0, segments=40)
    assert edges_of(mesh).is_closed
    # A pyramid over a regular polygon: area n/2 sin(2 pi/n), a third of the height.
    assert signed_volume_m3(mesh) == pytest.approx(20 * np.sin(2 * np.pi / 40) * 1.5 / 3)
    assert surface(mesh, "steel").mesh is mesh
