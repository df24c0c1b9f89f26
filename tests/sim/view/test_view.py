from __future__ import annotations

import builtins
import errno
import re
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, transform
from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from eval.cli.commands.viewing import load_view
from eval.cli.main import main
from scenarios import load_scenario
from scenarios.schema import MeshFile, Mover, Place, Prop, Scenario, Shift, SurfaceChange, SurfacePlace, Tunnel
from sim.geometry.mesh import Mesh
from sim.scene import build_world
from sim.session.simulate import simulate, simulate_pair
from sim.session.truth import read_mover_track, read_pair_truth, read_true_poses
from sim.view import building, viewer
from sim.view.building import plan_drives
from sim.view.returns import _AIR_RGB, CHANGE_RGB, points_cloud, session_cloud
from sim.view.view import View, view_folder, view_pair, view_points, view_scenario, view_session, wall_bands
from sim.view.viewer import require_viser, running_server, show, write_html

viser = pytest.importorskip("viser", reason="the extra `view` is not installed")


@pytest.fixture(scope="module")
def scenario(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    return make_scenario(
        props=(
            make_prop("came", 0.3, change="added"),
            make_prop("went", 0.5, change="removed"),
            make_prop("pushed", 0.7, -0.9, change="moved", shift=Shift(distance_m=0.5)),
            make_prop("stays", 0.85, kind="barrel", size_m=(0.6, 0.6, 0.9)),
        )
    )


@pytest.fixture(scope="module")
def shown(scenario: Scenario) -> View:
    return view_scenario(scenario, 3)


@pytest.fixture(scope="module")
def pair(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "pair"
    simulate_pair(scenario, 3, out)
    return out


@pytest.fixture
def server() -> Iterator[Any]:
    with running_server(0) as running:
        yield running


def named(view: View) -> dict[str, Any]:
    parts = (*view.surfaces, *view.lines, *view.clouds, *view.labels, *view.bands)
    names = [part.name for part in parts]
    assert len(names) == len(set(names))
    return dict(zip(names, parts, strict=True))


def test_a_world_is_shown_with_walls_paths_and_changes_in_their_colours(shown: View, scenario: Scenario) -> None:
    parts = named(shown)
    changes = {name: part.rgb for name, part in parts.items() if name.startswith("changes/")}
    assert changes == {
        "changes/added/came": CHANGE_RGB["added"],
        "changes/removed/went": CHANGE_RGB["removed"],
        "changes/moved/pushed (before)": CHANGE_RGB["moved"],
        "changes/moved/pushed (after)": CHANGE_RGB["moved"],
    }
    assert {name.split("/")[1] for name in parts if name.startswith("props/")} == {"stays"}
    assert {name for name in parts if name.startswith("paths/")} == {"paths/before", "paths/after"}
    assert parts["labels/came"].text == "came, added"
    assert shown.notes == ()
    for item in build_world(scenario, 3).standing:
        if item.prop.name == "went":
            box = parts["changes/removed/went"].mesh.vertices
            middle = (box.min(axis=0) + box.max(axis=0)) / 2
            np.testing.assert_allclose(middle, (item.world_T_object @ [0, 0, 0.35, 1])[:3], atol=0.02)


def test_movers_are_shown_where_they_are_in_the_middle_of_each_session(
    server: Any, make_scenario: Callable[..., Scenario], tmp_path: Path
) -> None:
    stretch = {"between": ("a", "b"), "fractions": (0.2, 0.6)}
    movers = [
        Mover.model_validate({"name": "walker", "kind": "person", "sessions": "after", "path": stretch}),
        Mover.model_validate({"name": "guard", "kind": "person", "speed_mps": 0}),
    ]
    scenario = make_scenario(movers=tuple(movers))
    shown = view_scenario(scenario, 3)
    parts = named(shown)
    groups = {name.rpartition("/")[0] for name in parts if name.startswith("movers/")}
    assert groups == {"movers/before/guard", "movers/after/guard", "movers/after/walker"}
    assert [name for name in parts if name.endswith("/stretch")] == ["movers/after/walker/stretch"]
    simulate_pair(scenario, 3, tmp_path / "pair")
    of_pair = named(view_pair(tmp_path / "pair"))
    track = read_mover_track(tmp_path / "pair" / "after")
    assert track is not None
    middle = track.world_T_mover[0, len(track.n_returns[0]) // 2, :2, 3]
    helmet = of_pair["movers/after/walker/plastic"].mesh.vertices
    np.testing.assert_allclose(helmet[:, :2].mean(axis=0), middle, atol=0.2)
    np.testing.assert_array_equal(helmet, parts["movers/after/walker/plastic"].mesh.vertices)
    show(server, shown)
    switches = {handle.label: handle for handle in server.gui._gui_input_handle_from_uuid.values()}
    assert {"movers/before", "movers/after"} <= switches.keys()
    # at another time the walker and the sensor are elsewhere, and who stands is where he was
    nodes = {name: server.scene.get_handle_by_name(f"/{name}") for name in (*parts, "sensor/after")}
    was = {name: nodes[name].vertices.mean(axis=0) for name in (*groups_with(parts, "plastic"), "sensor/after")}
    flip(switches["share of the drives"], 0.1)
    moved_m = {name: float(np.linalg.norm(nodes[name].vertices.mean(axis=0) - was[name])) for name in was}
    drive = plan_drives(build_world(scenario, 3), scenario, 3)[0]["after"]
    sensor = nodes["sensor/after"].vertices.mean(axis=0)
    np.testing.assert_allclose(sensor, drive.world_T_sensor[int(0.1 * drive.n_scans), :3, 3], atol=1e-4)
    assert moved_m["sensor/after"] > 1
    assert moved_m["movers/after/walker/plastic"] > 0.3 > 0.1 > moved_m["movers/before/guard/plastic"]


def groups_with(parts: dict[str, Any], material: str) -> list[str]:
    return [name for name in parts if name.startswith("movers/") and name.endswith(f"/{material}")]


def test_the_player_shows_one_revolution_and_its_second_returns(server: Any, tmp_path: Path) -> None:
    settings = ["sensor.returns=dual", "sensor.sub_rays=7", "after.air.mist.visibility_m=20", "sensor.mode=512x10",
                "platform.scan_spacing_m=2"]  # fmt: skip
    simulate_pair(load_scenario("smoke/one_box", 3, settings), 3, tmp_path / "pair")
    view = view_pair(tmp_path / "pair")
    assert view.play is not None
    clouds = {cloud.name: cloud for cloud in view.play(0.4)[1]}
    assert set(clouds) == {f"revolution/{name}{second}" for name in ("before", "after") for second in ("", " second")}
    session = read_session(tmp_path / "pair" / "after")
    scan = int(0.4 * session.n_scans)
    first, second = np.split(session.chunk(0).range_mm[scan], 2)
    assert len(clouds["revolution/after"].points) == (first > 0).sum()
    assert len(clouds["revolution/after second"].points) == (second > 0).sum() > 100
    air = (clouds["revolution/after second"].colours["change"] == _AIR_RGB).all(axis=1)
    assert 0.3 < air.mean() < 1.0
    show(server, view)
    node = server.scene.get_handle_by_name("/revolution/after second")
    assert not node.visible
    switches = {handle.label: handle for handle in server.gui._gui_input_handle_from_uuid.values()}
    flip(switches["revolution/after second"], True)
    assert node.visible
    flip(switches["share of the drives"], 0.4)
    np.testing.assert_array_equal(node.points, clouds["revolution/after second"].points)
    # a session alone has no truth, and is played in its own frame
    alone = view_session(tmp_path / "pair" / "after")
    assert alone.play is not None
    assert {cloud.name for cloud in alone.play(1.0)[1]} == {"revolution/session", "revolution/session second"}


def test_rock_that_moved_is_shown_by_its_displacement_and_switched(
    server: Any, make_scenario: Callable[..., Scenario]
) -> None:
    surface = (
        SurfaceChange(name="heaved", kind="heave", depth_m=0.1, place=SurfacePlace(between=("a", "b"), fraction=0.3)),
        SurfaceChange(name="fell", kind="scar", depth_m=0.3, place=SurfacePlace(between=("a", "b"), fraction=0.7)),
    )
    scenario = make_scenario(surface=surface)
    shown = view_scenario(scenario, 3)
    parts = named(shown)
    after = {name.rpartition("/")[2]: part for name, part in parts.items() if name.startswith("rock/after/")}
    # the floor came up by 10 cm, the scar is 30 cm deep at most and its rubble higher than 20 cm
    assert {"+5 to +20 cm", "-20 cm and more", "+20 cm and more", "less than 0.5 cm"} <= after.keys()
    assert {part.rgb[0] > part.rgb[2] for name, part in after.items() if name.startswith("+")} == {True}
    assert {part.rgb[0] < part.rgb[2] for name, part in after.items() if name.startswith("-")} == {True}
    assert (np.abs(after["-20 cm and more"].mesh.vertices[:, 0] - 14.0) < 1.5).all()
    assert np.abs(after["+5 to +20 cm"].mesh.vertices[:, 0] - 6.0).min() < 0.3
    assert after["-20 cm and more"].mesh.vertices[:, 2].min() > 1.0  # it fell out of wall or roof
    # each face of the walls is shown once, before and after
    world = build_world(scenario, 3)
    n_still = sum(len(band.mesh.faces) for band in shown.bands)
    assert n_still + len(parts["rock/before/rock"].mesh.faces) == len(world.before.meshes[0].faces)
    assert n_still + sum(len(part.mesh.faces) for part in after.values()) == len(world.after.meshes[0].faces)
    legend = viewer._legend(shown)
    assert all(f'rgb{part.rgb}">■</span> {name}' in legend for name, part in after.items())
    show(server, shown)
    switches = {handle.label: handle for handle in server.gui._gui_input_handle_from_uuid.values()}
    for group, at_first in (("rock/before", False), ("rock/after", True)):
        assert server.scene.get_handle_by_name(f"/{group}").visible is switches[group].value is at_first
        flip(switches[group], not at_first)
        assert server.scene.get_handle_by_name(f"/{group}").visible is not at_first


def test_without_rock_that_moved_nothing_of_it_is_shown(shown: View) -> None:
    assert not [name for name in named(shown) if name.startswith("rock")]
    assert "rock" not in viewer._legend(shown)


def test_movers_that_find_no_way_are_a_note(make_scenario: Callable[..., Scenario]) -> None:
    path = {"between": ("a", "b"), "fractions": (0.2, 0.6), "lateral": 0.0}
    blocking = Mover.model_validate({"name": "walker", "kind": "person", "path": path})
    (note,) = view_scenario(make_scenario(movers=(blocking,)), 3).notes
    assert note.startswith("no movers: before: mover 'walker' finds no way")


def test_bands_hold_every_face_of_the_walls_once_and_by_height(shown: View, scenario: Scenario) -> None:
    wall = build_world(scenario, 3).before.meshes[0]
    assert sum(len(band.mesh.faces) for band in shown.bands) == len(wall.faces)
    corners = np.concatenate([band.mesh.vertices[band.mesh.faces] for band in shown.bands])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    whole = wall.vertices[wall.faces]
    cross = np.cross(whole[:, 1] - whole[:, 0], whole[:, 2] - whole[:, 0])
    assert area == pytest.approx(np.linalg.norm(cross, axis=1).sum())
    starts = [band.from_m for band in shown.bands]
    assert starts == sorted(starts)
    assert starts[0] == 0
    # the floor of this drift is level, at 0
    for band, end_m in zip(shown.bands, [*starts[1:], np.inf], strict=True):
        centres = band.mesh.vertices[band.mesh.faces].mean(axis=1)
        low_m = band.from_m if band.from_m else -np.inf
        assert (centres[:, 2] >= low_m - 1e-9).all()
        assert (centres[:, 2] < end_m + 1e-9).all()


def test_heights_follow_the_floor_of_a_ramp() -> None:
    along = np.arange(0.0, 60.0, 0.1)
    floor = np.column_stack([along, 0 * along, 0.2 * along])
    box = trimesh.creation.box(extents=(40, 4, 3)).subdivide_to_size(0.5)
    vertices = np.asarray(box.vertices) + np.array([30.0, 0.0, 1.5])
    vertices[:, 2] += 0.2 * vertices[:, 0]
    bands = wall_bands(Mesh(vertices, np.asarray(box.faces, dtype=np.int32)), floor, 3)
    roof = bands[-1].mesh
    # the roof is 3 m above the floor everywhere: all of it is in the last band, from one end to the other
    assert np.ptp(roof.vertices[:, 0]) == pytest.approx(40)
    lowest = bands[0].mesh
    height_m = lowest.vertices[:, 2] - 0.2 * lowest.vertices[:, 0]
    assert height_m.max() < 2.0


def test_a_pair_s_returns_are_thinned_placed_and_coloured_by_truth(pair: Path) -> None:
    view = view_pair(pair)
    assert [cloud.name for cloud in view.clouds] == ["returns/before", "returns/after"]
    truth = read_pair_truth(pair)
    after = read_session(pair / "after")
    kinds = {change.id: change.kind for change in truth.changes}
    poses = read_true_poses(pair / "after")
    cloud = session_cloud("returns/after", after, poses, kinds, max_points=20_000)
    assert 5_000 < len(cloud.points) <= 20_000 + after.n_chunks
    assert {name: len(colours) for name, colours in cloud.colours.items()} == dict.fromkeys(
        ("change", "instance", "session", "height"), len(cloud.points)
    )
    # returns of the added box are green, and lie in its bounding box (noise, and rolling with true column poses)
    green = (view.clouds[1].colours["change"] == CHANGE_RGB["added"]).all(axis=1)
    box = next(part for part in view.surfaces if part.name == "changes/added/came").mesh.vertices
    points = view.clouds[1].points[green]
    assert len(points) > 50
    assert (points > box.min(axis=0) - 0.1).all()
    assert (points < box.max(axis=0) + 0.1).all()


def test_returns_of_mist_are_light_blue(tmp_path: Path) -> None:
    settings = ["after.air.mist.visibility_m=12", "platform.scan_spacing_m=3"]
    simulate("smoke/one_box", 1, tmp_path / "pair", settings)
    before, after = view_pair(tmp_path / "pair").clouds
    blue = (140, 200, 240)
    for quantity in ("change", "instance"):
        assert 0.01 < (after.colours[quantity] == blue).all(axis=1).mean() < 0.9
        assert not (before.colours[quantity] == blue).all(axis=1).any()


def test_a_session_is_placed_as_the_pipeline_places_it(pair: Path) -> None:
    view = view_folder(pair / "before")
    session = read_session(pair / "before")
    full = session_cloud("x", session, session.odom_T_sensor, None, max_points=10**9)
    scans = list(open_session(pair / "before").scans())
    expected: Float64Array = np.concatenate(
        [scan.points_sensor @ scan.odom_T_sensor[:3, :3].T + scan.odom_T_sensor[:3, 3] for scan in scans]
    )
    assert len(full.points) == len(expected)
    np.testing.assert_allclose(full.points.min(axis=0), expected.min(axis=0), atol=1e-5)
    np.testing.assert_allclose(full.points.astype(np.float64).mean(axis=0), expected.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(full.points.astype(np.float64).std(axis=0), expected.std(axis=0), atol=1e-6)
    assert list(view.clouds[0].colours) == ["height"]
    assert view.bands == ()


def test_what_lies_in_the_coordinates_of_a_map_grid_is_shown_less_a_place(
    pair: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = read_session(pair / "after")
    grid = np.array([432_000.0, 5_411_000.0, 0.0])
    poses = session.odom_T_sensor.copy()
    poses[:, :3, 3] += grid
    far = replace(session, odom_T_sensor=poses)
    usual = view_session(pair / "after")
    assert usual.notes == ()
    monkeypatch.setattr("sim.view.view.read_session", lambda _: far)
    scan = open_session(pair / "after").scan(0)
    points = transform(poses[0], scan.points_sensor)
    nearby = points_cloud("returns/session", points - grid)
    for view, wanted in ((view_session(pair / "after"), usual.clouds[0]), (view_points("r", points, poses), nearby)):
        assert view.notes == ("shown about 432000, 5411000, 0 m",)
        np.testing.assert_allclose(view.clouds[0].points, wanted.points, atol=1e-4)
        np.testing.assert_allclose(view.lines[0].points, usual.lines[0].points, atol=1e-6)
        np.testing.assert_allclose(view.target, usual.target, atol=1e-6)
        assert view.play is not None
        np.testing.assert_allclose(view.play(0.0)[0][0].mesh.vertices.mean(axis=0), poses[0, :3, 3] - grid, atol=1e-3)


def test_a_path_that_cannot_be_driven_is_a_note(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    def barred(*_arguments: Any) -> Any:
        raise ScenarioError("box bars the way")

    monkeypatch.setattr(building, "plan_trajectory", barred)
    view = view_scenario(scenario, 3)
    assert view.lines == ()
    assert len(view.notes) == 2
    assert all(
        name in note and "box bars the way" in note for name, note in zip(("before", "after"), view.notes, strict=True)
    )


def test_the_server_holds_every_part_and_its_switches_work(server: Any, shown: View, pair: Path) -> None:
    view = view_pair(pair)
    show(server, view)
    nodes = {name: server.scene.get_handle_by_name(f"/{name}") for name in named(view)}
    assert all(handle is not None for handle in nodes.values())
    switches = {handle.label: handle for handle in server.gui._gui_input_handle_from_uuid.values()}
    for label in ("walls", "props", "labels", "changes/added", "changes/moved", "paths/before", "returns/after"):
        handle = server.scene.get_handle_by_name(f"/{label}")
        before = handle.visible
        flip(switches[label], not before)
        assert handle.visible is not before
    flip(switches["walls up to, m above floor"], 1.0)
    for band in view.bands:
        assert nodes[band.name].visible == (band.from_m < 1.0 - 1e-6)
    flip(switches["walls seen"], "from both sides")
    assert {nodes[band.name].side for band in view.bands} == {"double"}
    flip(switches["returns by"], "session")
    np.testing.assert_array_equal(nodes["returns/after"].colors, view.clouds[1].colours["session"])
    vertices = nodes["changes/added/came"].vertices
    assert vertices.dtype == np.float32
    np.testing.assert_allclose(vertices, named(shown)["changes/added/came"].mesh.vertices, atol=1e-5)


def flip(switch: Any, value: Any) -> None:
    """Set a switch as a browser would, and run what hangs on it."""
    switch.value = value
    for callback in switch._impl.update_cb:
        callback(None)


def test_the_page_is_one_file_that_loads_nothing(shown: View, tmp_path: Path) -> None:
    file = tmp_path / "world.html"
    write_html(shown, file)
    text = file.read_text()
    assert "__VISER_EMBED_DATA__" in text
    page = text.split("window.__VISER_EMBED_DATA__")[0] + text.split("window.__VISER_EMBED_CONFIG__")[1]
    assert re.findall(r"""(?:src|href)\s*=\s*["']?(?!data:|#)(?:https?:)?//[^"'\s>]+""", page) == []
    assert re.findall(r"@import|<iframe|<link[^>]+stylesheet", page) == []
    small = tmp_path / "small.html"
    view = View(shown.title, (), (), (), (), (), shown.eye, shown.target)
    write_html(view, small)
    # the walls are in the file, not a reference to them
    assert file.stat().st_size > small.stat().st_size + 10_000
    with pytest.raises(InputError, match=r"none/x\.html: "):
        write_html(view, tmp_path / "none" / "x.html")


def test_a_full_disk_leaves_the_earlier_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(path: Path, text: str, **_: str) -> None:
        with path.open("w", encoding="utf-8") as file:
            file.write(text[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    page = tmp_path / "x.html"
    page.write_bytes(b"earlier")
    monkeypatch.setattr(Path, "write_text", fill)
    with pytest.raises(InputError, match=r"x\.html: cannot be written: No space left on device"):
        write_html(View("x", (), (), (), (), (), np.ones(3), np.zeros(3)), page)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("x.html", b"earlier")]


def test_a_taken_port_and_a_missing_viser_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("localhost", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=rf"--port {port}: taken by another program"), running_server(port):
            pass
    usual = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name == "viser":
            raise ImportError(name)
        return usual(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install 'tunnelcd\[view\]'"):
        require_viser()


def test_what_is_asked_for_is_found_or_named(pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_view(str(pair)).clouds
    assert load_view(str(pair / "after")).bands == ()
    for what, seed, words in (
        (str(pair / "truth"), None, "neither a simulated pair nor a session"),
        (str(pair), 3, "leave --seed and --world out"),
        ("smoke/one_bo", None, 'did you mean "smoke/one_box"'),
        (str(tmp_path / "gone"), None, "neither a folder nor a scenario"),
        (str(tmp_path / "gone.yaml"), None, "no such file"),
    ):
        with pytest.raises(InputError, match=re.escape(words)):
            load_view(what, seed)
    (tmp_path / "two" / "before").mkdir(parents=True)
    (tmp_path / "two" / "before" / "session.json").write_text("{}")
    with pytest.raises(InputError, match="a pair without truth"):
        load_view(str(tmp_path / "two"))
    # a folder of the same name does not hide a scenario
    (tmp_path / "smoke" / "one_box").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert load_view("smoke/one_box", 4).title == "smoke/one_box, seed 4"


def test_the_command_writes_a_page_and_tells_faults_in_one_line(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def call(*argv: str) -> tuple[int, str, list[str]]:
        with pytest.raises(SystemExit) as caught:
            main(["view", *argv])
        out, err = capsys.readouterr()
        return int(caught.value.code or 0), out, err.splitlines()

    file = tmp_path / "pair.html"
    code, out, err = call(str(pair), "--html", str(file))
    assert (code, err) == (0, [])
    assert out.startswith(f"{file}: {pair}, ") and file.stat().st_size > 1_000_000
    assert call(str(pair), "--html", str(file), "--quiet") == (0, "", [])
    (tmp_path / "mine.html").write_text("<!doctype html><html><head><title>My notes on tunnelcd</title></head></html>")
    for mine in (pair / "after" / "session.json", tmp_path / "mine.yaml", tmp_path / "mine.html"):
        mine.touch()
        content = mine.read_bytes()
        told = (
            f"error: {mine}: exists, and is no page of this version of `tunnelcd view`: name a new file, or remove it"
        )
        assert call(str(pair), "--html", str(mine)) == (2, "", [told])
        assert mine.read_bytes() == content
    missing = tmp_path / "none" / "x.html"
    code, out, err = call(str(pair), "--html", str(missing))
    assert (code, out, len(err)) == (2, "", 1)
    assert err[0].startswith(f"error: --html {missing}: ")
    code, out, err = call("smoke/one_bo", "--html", str(file))
    assert (code, out, len(err)) == (2, "", 1)


def test_the_server_runs_until_interrupted(
    pair: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupted)
    with pytest.raises(SystemExit) as caught:
        main(["view", str(pair / "after"), "--port", "0"])
    out, err = capsys.readouterr()
    assert not caught.value.code
    assert re.fullmatch(rf"{re.escape(str(pair / 'after'))}: http://localhost:\d+ \(Ctrl-C ends\)\n", out)
    assert err == ""


@pytest.mark.parametrize(("host", "n_warnings"), [("127.0.0.1", 0), ("::1", 0), ("0.0.0.0", 1), ("gate.example", 1)])
def test_an_address_that_other_machines_reach_is_told(
    host: str, n_warnings: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> None:
        raise InputError("far enough")

    monkeypatch.setattr(viewer, "running_server", stopped)
    with pytest.raises(SystemExit):
        main(["view", "smoke/one_box", "--host", host, "--quiet"])
    *warnings, error = capsys.readouterr().err.splitlines()
    assert [line.partition(":")[0] for line in warnings] == ["warning"] * n_warnings
    assert error == "error: far enough"


def test_the_server_listens_on_loopback_unless_told_otherwise(server: Any) -> None:
    with socket.socket() as asked, pytest.raises(ConnectionRefusedError):
        asked.connect(("127.0.0.2", server.get_port()))  # of this machine too, and answered where all addresses are
    socket.create_connection(("127.0.0.1", server.get_port())).close()


def test_a_foreign_mesh_without_drifts_is_shown(tmp_path: Path, make_scenario: Callable[..., Scenario]) -> None:
    solid = trimesh.creation.box(extents=(20, 4, 3)).subdivide()
    solid.apply_translation((10, 0, 1.5))
    solid.invert()
    solid.export(tmp_path / "mine.stl")
    chair = trimesh.creation.box(extents=(0.5, 0.5, 0.9))
    chair.export(tmp_path / "chair.stl")
    lines = "".join(f"{i} {2 + 0.5 * i} 0 0.8 0 0 0 1\n" for i in range(30))
    (tmp_path / "drive.tum").write_text(lines)
    plan = {"trajectory": str(tmp_path / "drive.tum")}
    prop = Prop(
        name="chair",
        kind="mesh",
        mesh=MeshFile(path=str(tmp_path / "chair.stl")),
        place=Place(at=(10, 1.2, 0.5)),
        change="added",
    )
    tunnel = Tunnel(mesh=MeshFile(path=str(tmp_path / "mine.stl")))
    view = view_scenario(make_scenario(tunnel=tunnel, props=(prop,), before=plan, after=plan), 0)
    parts = named(view)
    vertices = parts["changes/added/chair"].mesh.vertices
    np.testing.assert_allclose(vertices.min(axis=0), [9.75, 0.95, 0.0], atol=0.02)
    assert np.ptp(parts["paths/after"].points[:, 0]) > 10
    assert len(view.bands) > 3
