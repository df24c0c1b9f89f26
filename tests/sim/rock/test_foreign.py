from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from cdpipe.core.errors import ScenarioError
from scenarios.schema import MeshFile
from sim.geometry.mesh import Mesh
from sim.geometry.topology import closed_volume_m3, void_winding, winding_number
from sim.rock import foreign
from sim.rock.foreign import UNIT_M, prop_mesh, tunnel_mesh

Solid = trimesh.Trimesh


def tube(length_m: float = 40.0) -> Solid:
    """A closed drift 4 m wide and 3 m high from x = 0 on, its faces inwards, cut finely enough to have inner edges."""
    solid = trimesh.creation.box(extents=(length_m, 4.0, 3.0)).subdivide().subdivide()
    solid.apply_translation((length_m / 2, 0.0, 1.5))
    solid.invert()
    return solid


def chair(scale: float = 1.0) -> Solid:
    """A seat 0.5 x 0.4 m with a back 0.9 m high, off the origin: two closed parts that touch nowhere."""
    seat, back = (trimesh.creation.box(extents=size) for size in ((0.5, 0.4, 0.05), (0.05, 0.4, 0.5)))
    seat.apply_translation((3.0, 2.0, 0.425))
    back.apply_translation((2.775, 2.0, 0.65))
    solid = trimesh.util.concatenate([seat, back])
    solid.apply_scale(scale)
    return solid


def saved(folder: Path, solid: Any, name: str, **settings: Any) -> MeshFile:
    solid.export(folder / name)
    return MeshFile(path=str(folder / name), **settings)


def refusal(call: Callable[[], Mesh]) -> str:
    with pytest.raises(ScenarioError) as error:
        call()
    assert "\n" not in str(error.value)
    return str(error.value)


def assert_same_surface(mesh: Mesh, triangles: npt.NDArray[np.float64], atol: float = 1e-5) -> None:
    """Compare two sets of triangles whatever their order and the corner they start at."""

    def rows(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        turned = [
            np.roll(corner, -min(range(3), key=lambda i: tuple(corner[i].round(4))), axis=0) for corner in corners
        ]
        flat = np.array(turned).reshape(-1, 9)
        return flat[np.lexsort(flat.round(4).T)]

    np.testing.assert_allclose(rows(mesh.vertices[mesh.faces]), rows(np.asarray(triangles)), atol=atol)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_every_format_gives_the_same_welded_tunnel(tmp_path: Path, suffix: str) -> None:
    solid = tube()
    mesh = tunnel_mesh(saved(tmp_path, solid, f"mine.{suffix}"))
    assert_same_surface(mesh, solid.triangles)
    # a closed surface of genus 0 has V = 2 + F / 2 vertices: those of STL, three for each face, are merged
    assert len(mesh.vertices) == 2 + len(mesh.faces) / 2
    assert closed_volume_m3(mesh) == pytest.approx(-40 * 4 * 3, rel=1e-5)


@pytest.mark.parametrize("units", list(UNIT_M))
def test_units_become_metres(tmp_path: Path, units: str) -> None:
    solid = chair(1.0 / UNIT_M[units])
    mesh = prop_mesh(saved(tmp_path, solid, "chair.stl", units=units), "chair")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.5, 0.4, 0.5], atol=1e-5)
    # 0.5 x 0.4 x 0.05 and 0.05 x 0.4 x 0.5
    assert closed_volume_m3(mesh) == pytest.approx(0.02, rel=1e-4)


@pytest.mark.parametrize(("up", "axis"), [("x", 0), ("y", 1), ("z", 2)])
def test_the_named_axis_points_up_and_nothing_is_mirrored(tmp_path: Path, up: str, axis: int) -> None:
    # a wedge: wide at its foot, a point on top
    low = np.roll([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], axis - 2, axis=1)
    top = np.roll([[0.2, 0.2, 2.0]], axis - 2, axis=1)
    solid = trimesh.convex.convex_hull(np.concatenate([low, top]))
    mesh = prop_mesh(saved(tmp_path, solid, "wedge.ply", up=up), "wedge")
    assert (mesh.vertices[:, 2] == 0).sum() == 3
    assert mesh.vertices[:, 2].max() == pytest.approx(2.0)
    assert closed_volume_m3(mesh) == pytest.approx(1 / 3, rel=1e-6)


def test_a_prop_s_origin_is_on_the_floor_in_the_middle_of_its_footprint(tmp_path: Path) -> None:
    mesh = prop_mesh(saved(tmp_path, chair(), "chair.obj"), "chair")
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.25, -0.2, 0.0], atol=1e-7)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.25, 0.2, 0.5], atol=1e-7)


def test_a_scene_of_several_bodies_is_read_with_their_places(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(extents=(0.2, 0.2, 0.2)), node_name="a")
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1), (0, 0, 0))
    turn[:3, 3] = (1.0, 0.0, 0.0)
    scene.add_geometry(trimesh.creation.box(extents=(0.4, 0.2, 0.2)), node_name="b", transform=turn)
    mesh = prop_mesh(saved(tmp_path, scene, "two.glb"), "two")
    assert len(mesh.faces) == 24
    # from x = -0.1 to x = 1 + 0.1: the second, turned, is 0.2 long and 0.4 wide
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1.2, 0.4, 0.2], atol=1e-7)


def test_files_that_hold_no_surface_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def told(name: str, content: bytes | None) -> str:
        if content is not None:
            (tmp_path / name).write_bytes(content)
        return refusal(lambda: tunnel_mesh(MeshFile(path=str(tmp_path / name))))

    assert told("none.stl", None) == f"tunnel.mesh: {tmp_path / 'none.stl'}: no such file"
    assert told("mine.step", b"x").endswith(".stl, .obj, .ply or .glb")
    assert "empty" in told("empty.stl", b"")
    for name in ("a.ply", "a.glb"):
        assert "unreadable" in told(name, b"\x00\x01garbage" * 30)
    assert "no triangles" in told("a.stl", b"\x00\x01garbage" * 30)
    assert "no triangles" in told("lines.obj", b"v 0 0 0\nv 1 0 0\nl 1 2\n")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    assert "no triangles" in told("cloud.ply", None)
    solid = tube()
    content = solid.export(file_type="stl")
    assert "no triangles" in told("cut.stl", content[: len(content) // 2])
    solid.vertices[3, 1] = np.nan
    assert "1 vertices are not finite" in told("nan.ply", solid.export(file_type="ply"))
    monkeypatch.setattr(foreign, "MAX_TRIANGLES", 100)
    assert "192 triangles" in told("big.stl", tube().export(file_type="stl"))


def glb_of(path: Path, nodes: list[dict[str, Any]], n_primitives: int = 1, **accessor: Any) -> MeshFile:
    """Write a GLB of a tetrahedron with 1 m edges along the axes, as many times as primitives, at nodes."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint32)
    data = corners.tobytes() + faces.tobytes()
    table = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * n_primitives}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 48}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"componentType": 5125, "count": 12, "type": "SCALAR", **(accessor or {"bufferView": 1})},
        ],
    }
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<L4s", len(text), b"JSON") + text + struct.pack("<L4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sLL", b"glTF", 2, 12 + len(chunks)) + chunks)
    return MeshFile(path=str(path))


def test_a_small_file_that_asks_for_much_time_or_memory_is_refused(tmp_path: Path) -> None:
    def told(*content: Any, **accessor: Any) -> str:
        return refusal(lambda: prop_mesh(glb_of(tmp_path / "a.glb", *content, **accessor), "x"))

    chain = [{"mesh": 0, "children": [index + 1]} for index in range(60)]
    assert len(prop_mesh(glb_of(tmp_path / "a.glb", [*chain, {}], 2), "x").faces) == 2 * 4 * 60
    assert "20,000 parts: join them to 5,000 at most" in told([{"mesh": 0}], 20_000)
    instances = [{"children": list(range(1, 5002))}, *[{"mesh": 0}] * 5001]
    assert "5,001 parts: join them to 5,000 at most" in told(instances)
    assert "deeper than 64 levels" in told([*({"mesh": 0, "children": [index + 1]} for index in range(100)), {}])
    assert "20,000,000 triangles" in told([{"mesh": 0}], count=60_000_000)
    assert "bytes would expand to 4" in told([{"mesh": 0}], count=10**9)
    for name, content in (
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(f"usemtl m{n}\nf 1 2 3\n" for n in range(6000))),
        ("a.stl", "solid x\nendsolid x\n" * 6000),
    ):
        (tmp_path / name).write_text(content)
        assert "6,000 parts" in refusal(lambda name=name: prop_mesh(MeshFile(path=str(tmp_path / name)), "x"))


@pytest.mark.parametrize("kind", ["a pipe", "a file", "nothing"])
def test_a_mesh_leads_to_no_other_file(tmp_path: Path, kind: str) -> None:
    file = glb_of(tmp_path / "a.glb", [{"mesh": 0}])
    raw = Path(file.path).read_bytes()
    n_table = int.from_bytes(raw[12:16], "little")
    table = json.loads(raw[20 : 20 + n_table]) | {"buffers": [{"byteLength": 96, "uri": "other"}]}
    text = json.dumps(table).encode()
    Path(file.path).write_bytes(struct.pack("<4sLLL4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)
    if kind == "a pipe":
        os.mkfifo(tmp_path / "other")  # whoever opens it waits for ever
    elif kind == "a file":
        (tmp_path / "other").write_bytes(raw[-96:])
    assert "a part of it lies in another file: export it as one" in refusal(lambda: prop_mesh(file, "x"))


def test_no_primitive_is_lost(tmp_path: Path) -> None:
    # trimesh's random names lose one in two such files
    mesh = prop_mesh(glb_of(tmp_path / "a.glb", [{"mesh": 0}], 5_000), "x")
    assert len(mesh.faces) == 4 * 5_000


def test_a_part_placed_many_times_counts_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign, "MAX_TRIANGLES", 39)
    nodes = [{"children": list(range(1, 11))}, *[{"mesh": 0}] * 10]
    assert "40 triangles" in refusal(lambda: prop_mesh(glb_of(tmp_path / "a.glb", nodes), "x"))


def test_a_chair_of_90_m_is_asked_for_its_units(tmp_path: Path) -> None:
    # 0.5 m and 90 "m": in centimetres 0.9 m, in inches 2.3 m
    file = saved(tmp_path, chair(90 / 0.5), "chair.stl")
    assert refusal(lambda: prop_mesh(file, "chair")) == (
        f"props.chair.mesh: {tmp_path / 'chair.stl'}: 90 m long: is the file in centimetres (0.9 m) or "
        "inches (2.29 m)? set props.chair.mesh.units: cm or in"
    )
    small = saved(tmp_path, chair(0.01 / 0.5), "small.stl", units="m")
    assert "0.02 to 15 m" in refusal(lambda: prop_mesh(small, "chair"))
    inches = saved(tmp_path, chair(), "thin.stl", units="mm")
    assert "metres (0.5 m)" in refusal(lambda: prop_mesh(inches, "chair"))


@pytest.mark.parametrize(("scale", "units"), [(1000.0, "mm"), (100.0, "cm"), (1 / 0.0254, "in")])
def test_tunnels_in_other_units_are_noticed(tmp_path: Path, scale: float, units: str) -> None:
    solid = tube()
    solid.apply_scale(scale)
    text = refusal(lambda: tunnel_mesh(saved(tmp_path, solid, "mine.stl")))
    assert f"set tunnel.mesh.units: {units}" in text
    mesh = tunnel_mesh(saved(tmp_path, solid, "mine.stl", units=units))
    assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(40, rel=1e-5)


def test_a_tunnel_far_from_the_origin_is_refused(tmp_path: Path) -> None:
    solid = tube()
    solid.apply_translation((451_000.0, 0.0, 0.0))
    assert "451 km from the origin" in refusal(lambda: tunnel_mesh(saved(tmp_path, solid, "mine.ply")))


def test_holes_are_counted_and_the_largest_is_placed(tmp_path: Path) -> None:
    solid = tube(20.0)
    middle = solid.triangles_center
    is_gone = (middle[:, 0] < 1e-6) | (np.arange(len(middle)) == np.argmax(middle[:, 2] - abs(middle[:, 0] - 10)))
    solid.update_faces(~is_gone)
    file = saved(tmp_path, solid, "mine.stl")
    text = refusal(lambda: tunnel_mesh(file))
    # the open end is cut into 4 edges a side, and one triangle is missing from the roof
    assert "open: 19 edges" in text and "14 m around, is at (0.0, 0.0, 1.5)" in text
    assert "tunnel.mesh.allow_open: true" in text
    mesh = tunnel_mesh(file.model_copy(update={"allow_open": True}))
    assert closed_volume_m3(mesh) is None
    solid.invert()
    outwards = saved(tmp_path, solid, "out.stl", allow_open=True)
    assert "inside out" in refusal(lambda: tunnel_mesh(outwards))


def test_a_tunnel_that_faces_into_the_rock_is_named_and_flip_turns_it(tmp_path: Path) -> None:
    solid = tube()
    solid.invert()
    file = saved(tmp_path, solid, "mine.stl")
    assert "tunnel.mesh.flip: true" in refusal(lambda: tunnel_mesh(file))
    right = tunnel_mesh(file.model_copy(update={"flip": True}))
    assert_same_surface(right, tube().triangles)
    good = saved(tmp_path, tube(), "good.stl", flip=True)
    assert "leave tunnel.mesh.flip out" in refusal(lambda: tunnel_mesh(good))


def test_a_pillar_in_the_void_faces_the_void_too(tmp_path: Path) -> None:
    pillar = trimesh.creation.box(extents=(2.0, 1.0, 2.0))
    pillar.apply_translation((20.0, 0.0, 1.5))
    room = trimesh.util.concatenate([tube(), pillar])
    mesh = tunnel_mesh(saved(tmp_path, room, "room.stl"))
    np.testing.assert_allclose(void_winding(mesh), -1.0, atol=1e-9)


def test_faces_that_disagree_are_counted(tmp_path: Path) -> None:
    solid = tube()
    solid.faces[7] = solid.faces[7][::-1]
    assert "3 edges" in refusal(lambda: tunnel_mesh(saved(tmp_path, solid, "mine.stl")))


def test_an_inside_out_prop_is_named_and_an_open_one_is_taken(tmp_path: Path) -> None:
    solid = chair()
    solid.invert()
    file = saved(tmp_path, solid, "chair.stl")
    assert "inside out" in refusal(lambda: prop_mesh(file, "chair"))
    assert closed_volume_m3(prop_mesh(file.model_copy(update={"flip": True}), "chair")) == pytest.approx(0.02)
    solid = chair()
    solid.update_faces(np.arange(len(solid.faces)) > 0)
    mesh = prop_mesh(saved(tmp_path, solid, "open.stl"), "chair")
    assert (len(mesh.faces), closed_volume_m3(mesh)) == (23, None)
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1]], [[0, 1, 2], [2, 1, 3]])
    flat = saved(tmp_path, sheet, "sheet.stl")
    assert "all in one plane" in refusal(lambda: prop_mesh(flat, "sheet"))


def test_winding_numbers_of_a_box() -> None:
    triangles = np.asarray(trimesh.creation.box(extents=(2, 2, 2)).triangles)
    for point, turns in (((0.3, 0.2, -0.9), 1.0), ((0.3, 0.2, -1.1), 0.0), ((5.0, 0.0, 0.0), 0.0)):
        assert winding_number(np.array(point), triangles) == pytest.approx(turns, abs=1e-12)
    # in the middle of a face of an open box seen from its centre, five sixths of the sphere are left
    is_top = (triangles[:, :, 2] == 1).all(axis=1)
    assert winding_number(np.zeros(3), triangles[~is_top]) == pytest.approx(5 / 6, abs=1e-12)
