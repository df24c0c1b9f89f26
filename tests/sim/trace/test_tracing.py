from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
import yaml
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from cdpipe.core.errors import ScenarioError
from scenarios import check_scenario
from scenarios.schema import Drift, MeshFile, Section, Tunnel
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.rock.centreline import build_centreline
from sim.rock.tunnel import mesh_tunnel
from sim.trace import draft_scenario, format_scenario, save_picture, trace_mesh
from sim.trace.inside import find_inside
from sim.trace.route import find_route

WIDTH_M = 3.4
Points = npt.NDArray[np.float64]
Save = Callable[[trimesh.Trimesh, str], str]


def unchanged(solid: trimesh.Trimesh, line: Points) -> tuple[trimesh.Trimesh, Points, str]:
    return solid, line, "mine.stl"


def noisy(solid: trimesh.Trimesh, line: Points) -> tuple[trimesh.Trimesh, Points, str]:
    solid.vertices += np.random.default_rng(1).normal(0.0, 0.04, solid.vertices.shape)
    return solid, line, "mine.ply"


def full_of_holes(solid: trimesh.Trimesh, line: Points) -> tuple[trimesh.Trimesh, Points, str]:
    solid.update_faces(np.random.default_rng(2).random(len(solid.faces)) > 0.03)
    return solid, line, "mine.obj"


def sloping(solid: trimesh.Trimesh, line: Points) -> tuple[trimesh.Trimesh, Points, str]:
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(-10.0), (0, 1, 0))[:3, :3]
    solid.vertices = solid.vertices @ turn.T
    return solid, line @ turn.T, "mine.stl"


def as_glb(solid: trimesh.Trimesh, line: Points) -> tuple[trimesh.Trimesh, Points, str]:
    solid.vertices = solid.vertices[:, [0, 2, 1]] * (1, 1, -1)  # y up
    return solid, line, "mine.glb"


@pytest.mark.parametrize("change", [unchanged, noisy, full_of_holes, sloping, as_glb])
def test_a_grown_mine_is_traced_whole_and_can_be_driven(
    mine: Any, saved: Save, tmp_path: Path, change: Callable[..., tuple[trimesh.Trimesh, Points, str]]
) -> None:
    solid, line, name = change(mine.solid.copy(), mine.line.copy())
    found = trace_mesh(MeshFile(path=saved(solid, name), up="y" if name.endswith("glb") else "z"))
    traced = np.concatenate([drift.points for drift in found.drifts])
    covered = cKDTree(traced).query(line)[0] < WIDTH_M / 2
    assert covered.mean() >= 0.95
    off_m = cKDTree(line).query(list(found.nodes.values()))[0]
    assert off_m.max() < WIDTH_M / 2
    # two forks, two ends, and two ways between the forks
    kinds = [name.split("-")[0] for name in found.nodes]
    assert (kinds.count("junction"), kinds.count("end")) == (2, 2)
    # a blind drift goes on for half its width behind its last node, where no line does
    assert found.length_m == pytest.approx(mine.length_m - WIDTH_M, rel=0.06)
    assert all(drift.width_m == pytest.approx(WIDTH_M, abs=0.5) for drift in found.drifts)
    assert not found.notes
    draft = draft_scenario(found)
    assert draft.trouble == ""
    (tmp_path / "traced.yaml").write_text(format_scenario(draft, found, tmp_path))
    scenario = check_scenario(str(tmp_path / "traced.yaml"))
    assert [(prop.kind, prop.change) for prop in scenario.props] == [("box", "added")]
    assert scenario.tunnel.mesh is not None
    assert scenario.tunnel.mesh.allow_open == (change is full_of_holes)


def test_a_mesh_that_faces_the_rock_is_turned(tube: Callable[..., trimesh.Trimesh], saved: Save) -> None:
    solid = tube()
    solid.invert()
    found = trace_mesh(MeshFile(path=saved(solid, "out.stl")))
    assert found.file.flip
    assert next(iter(found.nodes)) == "end-1"
    (drift,) = found.drifts
    assert (drift.width_m, drift.height_m) == (pytest.approx(4.0, abs=0.02), pytest.approx(3.0, abs=0.02))
    np.testing.assert_allclose(drift.points[:, 1:], 0.0, atol=0.1)
    assert drift.points[0, 0] == pytest.approx(2.0, abs=0.7)  # half a width before the face
    assert drift.length_m == pytest.approx(36.0, abs=1.5)


def test_the_written_scenario_is_plain_and_finds_its_mesh_through_links(
    tube: Callable[..., trimesh.Trimesh], saved: Save, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = trace_mesh(MeshFile(path=saved(tube(), "tube.stl")))
    found = replace(found, nodes={name: (x, -0.0, z) for name, (x, _, z) in found.nodes.items()})
    draft = draft_scenario(found)
    (tmp_path / "deep" / "er").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    Path("linkdir").symlink_to("deep/er")
    text = format_scenario(draft, found, Path("linkdir"))
    assert "&id" not in text and "*id" not in text and "-0.0" not in text
    tree = yaml.safe_load(text)
    assert tree["before"]["route"] == tree["after"]["route"] == list(draft.route)
    Path("linkdir/s.yaml").write_text(text)
    assert check_scenario("linkdir/s.yaml").tunnel.mesh is not None
    assert check_scenario("deep/er/s.yaml").tunnel.mesh is not None


def refusal(path: str, **known: Any) -> str:
    with pytest.raises(ScenarioError) as error:
        trace_mesh(MeshFile(path=path, **known))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_scaled_turned_and_roofless_meshes_are_noticed(tube: Callable[..., trimesh.Trimesh], saved: Save) -> None:
    millimetres = tube()
    millimetres.apply_scale(1000.0)
    assert "3e+03 m across: is it in other units? give --units mm (3 m)" in refusal(saved(millimetres, "mm.stl"))
    feet = tube()
    feet.apply_scale(1 / 0.3048)
    (note,) = trace_mesh(MeshFile(path=saved(feet, "feet.stl"))).notes
    assert "--units ft" in note
    assert not trace_mesh(MeshFile(path=saved(feet, "ft.stl")), is_sure_of_units=True).notes
    roofless = tube()
    roofless.update_faces(roofless.face_normals[:, 2] > -0.5)
    assert "no roof" in refusal(saved(roofless, "pit.stl"))
    ball = trimesh.creation.icosphere(radius=3.0)
    ball.invert()
    assert "no drift in it" in refusal(saved(ball, "ball.stl"))
    sheet = trimesh.Trimesh([[0, 0, 0], [50, 0, 0], [0, 50, 0], [50, 50, 0]], [[0, 1, 2], [1, 3, 2]])
    assert "no inside" in refusal(saved(sheet, "sheet.stl"))


def test_a_mesh_in_the_coordinates_of_a_country_is_refused_before_the_long_work(
    tube: Callable[..., trimesh.Trimesh], saved: Save
) -> None:
    solid, steps = tube(), set()
    solid.apply_translation((432_000.0, 5_411_000.0, 310.0))
    with pytest.raises(ScenarioError, match=r"lies 5411 km from the origin.*subtract \(432000, 5411000, 300\) m"):
        trace_mesh(MeshFile(path=saved(solid, "utm.obj")), on_progress=lambda step, *_: steps.add(step))
    assert steps == {"read the mesh"}


def test_refusals_of_odd_widths_tell_a_way_out(tube: Callable[..., trimesh.Trimesh], saved: Save) -> None:
    tenth, slim = tube(), tube()
    tenth.apply_scale(0.1)
    told = refusal(saved(tenth, "tenth.stl"))
    assert "give scale" not in told and told.endswith("expected 0.5 to 60 m: scale the file")
    slim.apply_scale(0.25)
    (note,) = trace_mesh(MeshFile(path=saved(slim, "slim.stl"))).notes
    assert "give scale" not in note and note.endswith("if that is not so, scale the file")
    inner, outer = tube(), tube()
    outer.apply_scale((1.05, 1.1, 1.1))
    outer.vertices[:, 2] -= 0.1
    outer.invert()
    assert "of a lining with a thickness keep its inner surface only" in refusal(saved(inner + outer, "lining.stl"))


def test_a_line_too_short_for_a_drift_is_told_with_both_lengths(
    tube: Callable[..., trimesh.Trimesh], saved: Save
) -> None:
    told = refusal(saved(tube(9.0), "short.stl"))
    assert (found := re.search(r"its line is ([\d.]+) m long, shorter than 3 widths \(([\d.]+) m\)", told))
    assert 0 < float(found[1]) < float(found[2])


def test_a_mine_on_its_side_is_noticed(mine: Any, saved: Save) -> None:
    solid = mine.solid.copy()
    solid.vertices = solid.vertices[:, [0, 2, 1]] * (1, 1, -1)
    path = saved(solid, "side.stl")
    assert "give --up y, or --up z" in refusal(path)
    upright = saved(mine.solid, "upright.glb")
    assert "give --up z, or --up y" in refusal(upright, up="y")


def test_parts_that_do_not_meet_are_told(tube: Callable[..., trimesh.Trimesh], saved: Save) -> None:
    other = tube(30.0)
    other.apply_translation((0.0, 20.0, 5.0))
    found = trace_mesh(MeshFile(path=saved(trimesh.util.concatenate([tube(), other]), "two.stl")))
    (note,) = found.notes
    assert note.startswith("2 parts that do not meet")
    assert "m about (15, 20, 5)" in note
    assert len(found.drifts) == 2
    route = find_route(build_centreline(found.tunnel, 0), 1000.0)
    assert {route[0], route[-1]} == {found.drifts[0].nodes[0], found.drifts[0].nodes[-1]}


Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def hollow(*boxes: Box) -> trimesh.Trimesh:
    """The surface around boxes that overlap, each from a low to a high corner."""
    axes = [np.arange(min(box[0][k] for box in boxes) - 2, max(box[1][k] for box in boxes) + 2, 0.5) for k in range(3)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = np.min([np.maximum(low - places, places - high).max(axis=-1) for low, high in np.array(boxes)], axis=0)
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
    return trimesh.Trimesh(vertices * 0.5 + [axis[0] for axis in axes], faces, process=False)


def test_a_shaft_between_two_levels_is_left_out_and_told(saved: Save) -> None:
    solid = hollow(((0, -2, 0), (44, 2, 3)), ((0, -2, 14), (40, 2, 17)), ((18, -2, 0), (21, 2, 17)))
    found = trace_mesh(MeshFile(path=saved(solid, "levels.stl")))
    parts, shafts = found.notes
    assert parts.startswith("2 parts that do not meet")
    assert shafts.startswith("shafts or steps too steep to drive: 1 left out, the first at (20, 0, ")
    heights = {round(place[2]) for place in found.nodes.values()}
    assert heights == {0, 14}
    assert found.length_m == pytest.approx(44 + 40 - 4 * 2, abs=3)


def test_drifts_that_meet_in_a_hall_meet_at_one_place(saved: Save) -> None:
    hall = ((24, -10, 0), (44, 10, 5))
    solid = hollow(((0, -2, 0), (26, 2, 3)), hall, ((42, -2, 0), (70, 2, 3)), ((32, 8, 0), (36, 36, 3)))
    found = trace_mesh(MeshFile(path=saved(solid, "hall.stl")))
    assert [name for name in found.nodes if name.startswith("junction")] == ["junction-1"]
    np.testing.assert_allclose(found.nodes["junction-1"], (34, 0, 0), atol=1.5)
    assert sum(name.startswith("end") for name in found.nodes) == 3


def test_the_inside_of_a_box_has_its_volume_whatever_is_missing(tube: Callable[..., trimesh.Trimesh]) -> None:
    whole = tube(20.0)
    nothing, end = np.zeros(len(whole.faces), bool), whole.triangles_center[:, 0] < 1e-6
    for is_gone in (nothing, end, whole.face_normals[:, 2] < 0):
        faces = whole.faces[~is_gone]
        mesh = Mesh(np.asarray(whole.vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32))
        void = find_inside(mesh, Caster([mesh]), 0.25)
        # the majority of 27 cells takes the corners: less than a cell all round
        assert void.is_inside.sum() * 0.25**3 == pytest.approx(20 * 4 * 3, rel=0.08)
        asked = np.array([[10.0, 0.0, 1.5], [10.0, 0.0, 4.0], [10.0, 3.0, 1.5]])
        assert void.holds(asked).tolist() == [True, False, False]


def test_the_picture_is_a_png_whatever_the_mesh_is_called(
    tube: Callable[..., trimesh.Trimesh], saved: Save, tmp_path: Path
) -> None:
    found = trace_mesh(MeshFile(path=saved(tube(), "a$b$\\frac{.stl")))
    save_picture(found, tmp_path / "trace.png")
    assert (tmp_path / "trace.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(("width_m", "height_m"), [(4.0, 4.0), (5.5, 5.0)])
def test_a_smooth_drift_is_traced_from_end_to_end(width_m: float, height_m: float, saved: Save) -> None:
    nodes = {"a": (0, 0, 0), "b": (25, 0, 0), "c": (48, 12, 0)}
    for names in (("a", "b"), ("a", "b", "c")):
        section = Section(width_m=width_m, height_m=height_m, shape="d")
        used = {name: nodes[name] for name in names}
        tunnel = Tunnel(nodes=used, drifts=(Drift(nodes=names),), section=section, roughness=(), resolution_m=0.4)
        centreline = build_centreline(tunnel, 1)
        walls = mesh_tunnel(tunnel, centreline, 1)
        found = trace_mesh(MeshFile(path=saved(trimesh.Trimesh(walls.vertices, walls.faces, process=False), "d.ply")))
        length_m = float(np.linalg.norm(np.diff(centreline.drifts[0].points, axis=0), axis=1).sum())
        assert found.length_m > length_m - 1.5 * width_m, names


def test_faces_that_are_turned_are_named_before_anything_is_traced(
    tube: Callable[..., trimesh.Trimesh], saved: Save
) -> None:
    solid = tube()
    solid.faces[::3] = solid.faces[::3, ::-1]
    assert "the two faces do not face the same way" in refusal(saved(solid, "mixed.ply"))


def test_a_steep_ramp_is_refused_with_the_way_to_trace_it(saved: Save) -> None:
    nodes = {"a": (0, 0, 0), "b": (30, 0, 20)}
    solid = trimesh.creation.box(extents=(36.0, 4.0, 4.0)).subdivide_to_size(1.0)
    solid.apply_transform(trimesh.transformations.rotation_matrix(-np.arctan2(20, 30), (0, 1, 0)))
    solid.apply_translation(np.mean(list(nodes.values()), axis=0))
    solid.invert()
    assert "--up z for a shaft or a ramp" in refusal(saved(solid, "ramp.stl"))
