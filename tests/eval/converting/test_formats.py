"""Sessions leave in formats of others: our own readers and the others' programs read what was written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

from cdpipe.core.geometry import Float64Array, invert, transform
from cdpipe.io.answer import write_answer
from cdpipe.io.foreign import read_poses
from cdpipe.io.out.clouds import write_laz
from cdpipe.io.out.maps import PointMap
from cdpipe.io.ply import read_ply, write_ply_points
from cdpipe.io.readers import open_session
from cdpipe.io.session import Session, read_session
from cdpipe.mapping.mapping import choose_keyframes
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from eval.converting.truth import truth_fields
from scenarios import load_scenario
from sim.rock.glb import count_glb
from sim.session.truth import read_pair_truth, read_true_poses
from tests.cdpipe.io.foreign_files import drive, write_merged_e57, write_trajectory
from tests.cdpipe.io.test_whole_map import drift

Result = tuple[int, str, str]
Command = Callable[..., Result]
SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=0.9")


@pytest.fixture(scope="module")
def pair(simulated_once: Callable[..., Path]) -> Path:
    return simulated_once(load_scenario("smoke/one_box", 5, SMALL), 5)


def odom_points(source: Any) -> list[Float64Array]:
    return [transform(scan.odom_T_sensor, scan.points_sensor) for scan in source.scans()]


def worst(one: Any, other: Any) -> float:
    """Return the largest distance between equal returns of two sources, in their odom frames, as a share of the range.

    Where points are deskewed from one set of poses and then another, they differ by an angle.
    """
    ranges_m = (np.linalg.norm(scan.points_sensor, axis=1) for scan in one.scans())
    pairs = zip(odom_points(one), odom_points(other), ranges_m, strict=True)
    return max(float((np.linalg.norm(a - b, axis=1) / np.maximum(range_m, 1.0)).max()) for a, b, range_m in pairs)


def convert(command: Command, *arguments: object) -> str:
    code, out, err = command("convert", *arguments)
    assert code == 0, err
    return out


def refused(result: Result, expected: str) -> None:
    code, out, err = result
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert expected in err


@pytest.mark.parametrize(
    ("name", "options"), [("a.mcap", ()), ("a.bag", ()), ("a", ("--to", "ros2")), ("run #2?", ("--to", "ros2"))]
)
def test_a_bag_comes_back_as_it_left(
    name: str, options: tuple[str, ...], pair: Path, tmp_path: Path, command: Command
) -> None:
    pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")
    said = convert(command, pair / "before", tmp_path / name, *options)
    session = open_session(pair / "before")
    assert said.startswith(f"{tmp_path / name}: {len(session.odom_T_sensor)} revolutions, without truth, ")
    assert [file.name for file in tmp_path.iterdir()] == [name]
    back = open_session(tmp_path / name)
    assert worst(session, back) < 2e-4
    for one, other in zip(session.scans(), back.scans(), strict=True):
        np.testing.assert_array_equal(one.intensity, other.intensity)


def test_frames_stamps_and_fields_of_a_bag_are_what_players_expect(
    pair: Path, tmp_path: Path, command: Command
) -> None:
    pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - only where the extra is installed

    convert(command, pair / "before", tmp_path / "bag", "--to", "ros2", "--with-truth")
    session = read_session(pair / "before")
    with AnyReader([tmp_path / "bag"]) as bag:
        found = [(each.topic, ns, bag.deserialize(raw, each.msgtype)) for each, ns, raw in bag.messages()]
    clouds = [(ns, message) for topic, ns, message in found if topic == "/points"]
    moved = [message.transforms[0] for topic, _, message in found if topic == "/tf"]
    assert {topic for topic, *_ in found} == {"/points", "/tf", "/clock"}
    assert {(each.header.frame_id, each.child_frame_id) for each in moved} == {("odom", "lidar")}
    tf_ns = np.array([int(each.header.stamp.sec) * 10**9 + int(each.header.stamp.nanosec) for each in moved])
    chunk = session.chunk(0)
    for number, (logged_ns, cloud) in enumerate(clouds):
        stamp_ns = int(cloud.header.stamp.sec) * 10**9 + int(cloud.header.stamp.nanosec)
        names = [each.name for each in cloud.fields]
        assert names == ["x", "y", "z", "t", "intensity", "ring", "change", "instance"]
        assert (cloud.header.frame_id, stamp_ns) == ("lidar", 10**9 + chunk.column_stamps_ns[number, 0])
        kinds = {each.name: each.datatype for each in cloud.fields}
        assert (kinds["x"], kinds["t"], kinds["ring"], kinds["change"]) == (7, 6, 4, 3)
        # every point lies between two transforms that are known when the cloud arrives
        table = cloud.data[: cloud.width * cloud.point_step].reshape(cloud.width, cloud.point_step)
        offsets_ns = table[:, 12:16].copy().view("<u4")[:, 0]
        assert tf_ns[tf_ns <= logged_ns].max() >= stamp_ns + int(offsets_ns.max())
        assert tf_ns.min() <= stamp_ns


def test_the_library_of_mcap_reads_one(pair: Path, tmp_path: Path, command: Command) -> None:
    reader = pytest.importorskip("mcap.reader", reason="pip install 'tunnelcd[formats]'")
    convert(command, pair / "before", tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        opened = reader.make_reader(file, validate_crcs=True)
        assert opened.get_header().profile == "ros2"
        found = [(schema.name, schema.encoding, message.log_time) for schema, _, message in opened.iter_messages()]
        assert opened.get_summary().statistics.message_count == len(found)
    n_scans = read_session(pair / "before").n_scans
    assert sum(name == "sensor_msgs/msg/PointCloud2" for name, *_ in found) == n_scans
    assert {encoding for _, encoding, _ in found} == {"ros2msg"}
    assert min(log_ns for *_, log_ns in found) == 10**9


def test_semantic_kitti(pair: Path, tmp_path: Path, command: Command) -> None:
    folder = tmp_path / "sequences" / "00"
    convert(command, pair / "after", folder, "--to", "semantic-kitti", "--with-truth")
    session = open_session(pair / "after")
    assert worst(session, open_session(folder)) < 1e-5
    names = yaml.safe_load((folder / "labels.yaml").read_text())["labels"]
    kinds = {change.id: f"change-{change.kind}" for change in read_pair_truth(pair).changes}
    fields = truth_fields(read_session(pair / "after"))
    counts = dict.fromkeys(names.values(), 0)
    for scan in session.scans():
        label = np.fromfile(folder / "labels" / f"{scan.index:06d}.label", "<u4")
        truth = fields(scan.index, scan.pixels)
        np.testing.assert_array_equal(label >> 16, np.maximum(truth["instance"], 0))
        for number in np.unique(label & 0xFFFF).tolist():
            counts[names[number]] += np.count_nonzero(label & 0xFFFF == number)
        changed = {names[number] for number in (label[truth["change"] > 0] & 0xFFFF).tolist()}
        assert changed <= set(kinds.values())
    assert counts["walls-floor-fixtures"] > 10 * counts["change-added"] > 0
    kitti = pytest.importorskip("kiss_icp.datasets.kitti", reason="pip install 'tunnelcd[odometry]'")
    (tmp_path / "poses").mkdir()
    shutil.copy(folder / "poses.txt", tmp_path / "poses" / "00.txt")
    theirs = kitti.KITTIOdometryDataset(tmp_path, "0")
    assert len(theirs) == len(session.odom_T_sensor)
    np.testing.assert_allclose(theirs.gt_poses, session.odom_T_sensor, atol=1e-6)
    assert len(theirs.read_point_cloud(theirs.scan_files[0])) == len(session.scan(0).points_sensor)


def test_poses_and_the_true_ones_on_demand(pair: Path, tmp_path: Path, command: Command) -> None:
    session = read_session(pair / "before")
    convert(command, pair / "before", tmp_path / "a.tum", "--with-truth")
    convert(command, pair / "before", tmp_path / "b.kitti", "--with-truth")
    convert(command, pair / "before", tmp_path / "c.txt", "--to", "tum")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.true.tum", "a.tum", "b.kitti", "b.true.kitti", "c.txt",
    ]  # fmt: skip
    for name, wanted in (
        ("a.tum", session.odom_T_sensor), ("b.kitti", session.odom_T_sensor), ("c.txt", session.odom_T_sensor),
        ("a.true.tum", read_true_poses(pair / "before")), ("b.true.kitti", read_true_poses(pair / "before")),
    ):  # fmt: skip
        np.testing.assert_allclose(read_poses(tmp_path / name).poses, wanted, atol=1e-6)
    middle_ns = session.chunk(0).column_stamps_ns[:, 256]
    np.testing.assert_allclose(read_poses(tmp_path / "a.tum").time_s, 1.0 + middle_ns / 1e9, atol=1e-8)


def test_packets_come_back_with_the_poses_beside_them(pair: Path, tmp_path: Path, command: Command) -> None:
    pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
    from ouster.sdk import core, pcap  # noqa: PLC0415 - only where the extra is installed

    convert(command, pair / "before", tmp_path / "a.pcap")
    convert(command, pair / "before", tmp_path / "a.tum")
    convert(command, tmp_path / "a.pcap", tmp_path / "s", "--trajectory", tmp_path / "a.tum")
    one, other = read_session(pair / "before"), read_session(tmp_path / "s")
    for first, second in zip(one.chunks(), other.chunks(), strict=True):
        for name in ("range_mm", "reflectivity", "signal"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_allclose(one.odom_T_sensor, other.odom_T_sensor, atol=1e-6)
    info = core.SensorInfo((tmp_path / "a.json").read_text())
    assert "smoke" not in (tmp_path / "a.json").read_text()
    source = pcap.PcapFrameSetSource(str(tmp_path / "a.pcap"), sensor_info=[info])
    assert sum(frames[0] is not None for frames in source) == one.n_scans


def check_map(points: Float64Array, instance: Any, session: Session, cell_m: float) -> None:
    """Check that a map holds returns of a session, one a cell and instance."""
    every = np.concatenate(odom_points(open_session(session.path)))
    cells, wanted = (np.unique(np.floor(of / cell_m), axis=0) for of in (points, every))
    assert 0.99 * len(wanted) < len(cells) < 1.01 * len(wanted)  # rounding moves a few points to the next cell
    assert len(points) < 1.02 * len(cells)
    assert instance is None or {0} < set(np.unique(instance).tolist())


def test_a_map_with_scalar_fields(pair: Path, tmp_path: Path, command: Command) -> None:
    session = read_session(pair / "after")
    for name in ("a.laz", "a.las", "a.ply"):
        convert(command, pair / "after", tmp_path / name, "--with-truth", "--cell", "0.2")
    points, scalars = read_ply(tmp_path / "a.ply", ("intensity", "time", "change", "instance", "ring", "scan"))
    assert len(scalars) == 6
    check_map(points, scalars["change"], session, 0.2)
    laspy = pytest.importorskip("laspy", reason="pip install 'tunnelcd[formats]'")
    for name in ("a.laz", "a.las"):
        cloud = laspy.read(tmp_path / name)
        assert cloud.header.are_points_compressed == (name == "a.laz")
        np.testing.assert_allclose(cloud.xyz, points, atol=1e-4)
        np.testing.assert_array_equal(cloud.change, scalars["change"])
        np.testing.assert_array_equal(cloud.intensity, scalars["intensity"])
        np.testing.assert_allclose(cloud.gps_time - cloud.gps_time.min(), scalars["time"], atol=1e-4)
    convert(command, pair / "after", tmp_path / "bare.laz", "--cell", "0.2")
    assert "change" not in set(laspy.read(tmp_path / "bare.laz").point_format.dimension_names)


def test_intensities_of_a_laz_are_whole_and_shares_fill_16_bits(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy", reason="pip install 'tunnelcd[formats]'")
    for values, expected in (
        ([0.0, 0.5, 0.99, 1.0], [0, 32768, 64880, 65535]),
        ([0.0, 1.0, 7.6, 9e9], [0, 1, 8, 65535]),
    ):
        write_laz(tmp_path / "a.laz", PointMap(np.zeros((4, 3)), {"intensity": np.array(values, np.float32)}))
        assert laspy.read(tmp_path / "a.laz").intensity.tolist() == expected


def test_each_session_of_a_laz_has_the_unit_of_its_intensities(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy", reason="pip install 'tunnelcd[formats]'")
    values = {"intensity": np.array([0.5, 255.0, 1.0, 7.0], np.float32), "session": np.array([0, 1, 0, 1], np.int32)}
    write_laz(tmp_path / "a.laz", PointMap(np.zeros((4, 3)), values))
    assert laspy.read(tmp_path / "a.laz").intensity.tolist() == [32768, 255, 65535, 7]


def made_answer(pair: Path, folder: Path) -> ChangeReport:
    """Write an answer whose one object is what the truth calls changed, with the true merge."""
    fields, source = truth_fields(read_session(pair / "after")), open_session(pair / "after")
    found = [
        (scan.index, pixel)
        for scan in source.scans()
        for pixel in scan.pixels[fields(scan.index, scan.pixels)["change"] > 0].tolist()
    ]
    true = [read_true_poses(pair / name) for name in ("before", "after")]
    world_T = [poses[0] @ invert(read_session(pair / name).odom_T_sensor[0])
               for poses, name in zip(true, ("before", "after"), strict=True)]  # fmt: skip
    item = ChangedObject("after", "added", -1, np.array(found, np.int32), np.zeros((0, 3)), 1.0)
    regions = ChangeRegions(
        np.zeros((0, 3)), 4.5, np.zeros(0), np.zeros((0, 2), np.int64), np.zeros(0, bool), np.zeros(0)
    )
    keyframes = [choose_keyframes(read_session(pair / name).odom_T_sensor, 1.0) for name in ("before", "after")]
    settings = {"map": {"keyframe_spacing_m": 1.0}}
    merge = invert(world_T[0]) @ world_T[1]
    report = ChangeReport(merge, {}, regions, (item,), {}, {}, (keyframes[0], keyframes[1]), settings)
    write_answer(folder, "mine", report)
    return report


def test_the_map_of_an_answer(pair: Path, tmp_path: Path, command: Command) -> None:
    made_answer(pair, tmp_path / "answer")
    inputs = (pair / "before", pair / "after", tmp_path / "answer")
    said = convert(command, *inputs, tmp_path / "a.ply", "--cell", "0.1")
    names = ("session", "change", "instance", "distance", "displacement")
    points, scalars = read_ply(tmp_path / "a.ply", names)
    is_new = scalars["change"] == 1
    assert f"{len(points)} points, {np.count_nonzero(is_new)} of them on objects" in said
    np.testing.assert_array_equal(scalars["instance"], is_new)
    assert (scalars["session"][is_new] == 1).all()
    # what was added lies off the before map, all else on it: both are in one frame
    assert np.median(scalars["distance"][is_new]) > 0.15
    assert np.nanmedian(scalars["distance"][~is_new]) < 0.06
    assert np.isnan(scalars["displacement"]).all()
    refused(command("convert", *inputs, tmp_path / "a.mcap"), "an answer becomes a map with scalar fields: name a new")
    refused(command("convert", tmp_path / "answer", tmp_path / "b.laz"), "an answer, without its sessions")
    turned = (pair / "after", pair / "before", tmp_path / "answer", tmp_path / "b.laz", "--quiet")
    refused(command("convert", *turned), "is it an answer to this pair, and in this order?")


def test_a_world_as_glb(pair: Path, tmp_path: Path, command: Command) -> None:
    path = tmp_path / "w.glb"
    said = convert(command, "smoke/one_box", path, "--seed", "5")
    scene = trimesh.load(path)
    names = {name.rsplit("/", 1)[-1] for name in scene.graph.nodes_geometry}
    assert any("box" in name for name in names)
    assert f"{count_glb(path).parts} meshes, {count_glb(path).triangles} triangles" in said
    assert len(np.unique([mesh.visual.vertex_colors[0] for mesh in scene.geometry.values()], axis=0)) > 2
    assert scene.extents[1] < 8.0 < max(scene.extents[0], scene.extents[2])  # y is up
    refused(command("convert", pair, tmp_path / "p.glb"), "the world of a pair is its truth: add --with-truth")
    refused(command("convert", "smoke/one_box", tmp_path / "p.osf"), "a world: it becomes a GLB")
    refused(command("convert", pair / "before", tmp_path / "p.glb"), "a session has no surfaces")


def test_a_recording_leaves_in_formats_of_points(pair: Path, tmp_path: Path, command: Command) -> None:
    pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")
    convert(command, pair / "before", tmp_path / "a.mcap")
    convert(command, tmp_path / "a.mcap", tmp_path / "scans")
    scans = open_session(tmp_path / "scans")
    convert(command, tmp_path / "scans", tmp_path / "b.mcap")
    assert worst(scans, open_session(tmp_path / "b.mcap")) < 1e-5
    np.testing.assert_array_equal(next(scans.scans()).intensity, open_session(pair / "before").scan(0).intensity)
    _, scalars = read_ply(tmp_path / "scans" / "000000.ply", ("intensity", "time"))
    np.testing.assert_allclose(scalars["time"].max(), 0.0998, atol=1e-3)
    for wanted in (("b.osf",), ("b.pcap",), ("b", "--to", "pcd")):
        told = command("convert", tmp_path / "scans", tmp_path / wanted[0], *wanted[1:])
        refused(told, "these are bare points: name a new file that ends in .mcap, .bag, ")


def test_rerun_reads_its_recording(pair: Path, tmp_path: Path, command: Command) -> None:
    pytest.importorskip("rerun", reason="pip install 'tunnelcd[rerun]'")
    from rerun.chunk import RrdReader  # noqa: PLC0415 - only where the extra is installed

    convert(command, pair / "after", tmp_path / "a.rrd", "--with-truth")
    batches: dict[str, list[Any]] = {}
    for chunk in RrdReader(tmp_path / "a.rrd").stream():
        batches.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    clouds = [row for batch in batches["/odom/lidar/points"] for row in batch.column("Points3D:positions").to_pylist()]
    at = [row for batch in batches["/odom/lidar"] for row in batch.column("Transform3D:translation").to_pylist()]
    session = open_session(pair / "after")
    for scan, points, place in zip(session.scans(), clouds, at, strict=True):
        np.testing.assert_allclose(points, scan.points_sensor, atol=1e-5)
        np.testing.assert_allclose(place[0], scan.odom_T_sensor[:3, 3], atol=1e-6)


def test_what_cannot_be_written_is_one_line_and_leaves_nothing(
    pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = pair / "before"
    for arguments, expected in (
        ((before, tmp_path / "a.xyz"), "expected a new file that ends in .osf, .pcap, .mcap"),
        ((before, tmp_path / "a", "--to", "mcpa"), "--to mcpa: expected one of osf, pcap, mcap"),
        ((before, tmp_path / "a.pcap", "--with-truth"), "has no room for the truth"),
        ((before, before, tmp_path / "a.laz"), "2 inputs: expected one, or BEFORE AFTER ANSWER"),
        ((before, tmp_path / "a.laz", "--seed", "3"), "leave --seed and --world out"),
        (("smoke/one_bx", tmp_path / "a.glb"), 'scenario "smoke/one_bx": unknown'),
    ):
        refused(command("convert", *arguments), expected)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "chunk", interrupted)
    for name in ("a.mcap", "a.bag", "a.laz", "a.tum", "a.pcap"):
        assert command("convert", before, tmp_path / "new" / name, "--quiet")[0] == 130
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("far", ["trajectory", "point"])
def test_a_recording_too_far_away_for_a_map_is_one_line(tmp_path: Path, command: Command, far: str) -> None:
    made = drive(3, 200, 0.0)
    (tmp_path / "r").mkdir()
    for index, (points, _) in enumerate(made.clouds):
        lost = np.array([[1e7, 0.0, 0.0]] if far == "point" else np.zeros((0, 3)))
        write_ply_points(tmp_path / "r" / f"{index:06d}.ply", np.concatenate([points, lost]))
    rows = [line.split() for line in write_trajectory(tmp_path / "t", made.stamps_s).read_text().splitlines()]
    shift = 5e6 if far == "trajectory" else 0.0
    text = "".join(f"{row[0]} {float(row[1]) + shift} {' '.join(row[2:])}\n" for row in rows)
    (tmp_path / "r" / "trajectory.txt").write_text(text)
    refused(command("convert", tmp_path / "r", tmp_path / "a.ply"), "subtract a common offset from the trajectory")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r", "t"]


def write_recording(folder: Path, start_s: float = 0.0, far_m: float = 0.0) -> Path:
    """Write three scans, the second one without intensities, with a trajectory from a time and a place on."""
    made = drive(3, 200, 0.0)
    folder.mkdir()
    for index, (points, _) in enumerate(made.clouds):
        shone = {} if index == 1 else {"intensity": np.full(len(points), index + 5, np.float32)}
        write_ply_points(folder / f"{index:06d}.ply", points, shone)
    path = write_trajectory(folder / "trajectory.txt", made.stamps_s)
    rows = [line.split() for line in path.read_text().splitlines()]
    first_s = float(rows[0][0])
    lines = (f"{start_s + float(row[0]) - first_s:.9f} {float(row[1]) + far_m} {' '.join(row[2:])}\n" for row in rows)
    path.write_text("".join(lines))
    return folder


def test_scans_without_intensities_have_none_in_a_map(tmp_path: Path, command: Command) -> None:
    laspy = pytest.importorskip("laspy", reason="pip install 'tunnelcd[formats]'")
    source = write_recording(tmp_path / "r")
    for name in ("a.ply", "a.laz"):
        convert(command, source, tmp_path / name, "--cell", "0.01")
    _, scalars = read_ply(tmp_path / "a.ply", ("intensity", "scan"))
    expected = np.choose(scalars["scan"].astype(int), [5.0, np.nan, 7.0])
    np.testing.assert_array_equal(scalars["intensity"], expected)
    assert np.isnan(expected).any()
    np.testing.assert_array_equal(laspy.read(tmp_path / "a.laz").intensity, np.nan_to_num(expected))


@pytest.mark.parametrize(("start_s", "is_held"), [(-1.0, False), (2_147_483_640.0, True), (2_147_483_648.0, False)])
def test_a_bag_holds_the_times_that_ros_holds(tmp_path: Path, command: Command, start_s: float, is_held: bool) -> None:
    pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")
    source = write_recording(tmp_path / "r", start_s)
    for name, *options in (("a.mcap",), ("a.bag",), ("a", "--to", "ros2")):
        code, _, err = result = command("convert", source, tmp_path / name, "--quiet", *options)
        if is_held:
            assert (code, err) == (0, "")
            assert len(open_session(tmp_path / name).odom_T_sensor) == 3
        else:
            refused(result, "r: its times are ")
            assert "ROS holds 0 to 2147483647 s" in err
    assert len(list(tmp_path.iterdir())) == (4 if is_held else 1)


def test_a_map_without_scans_leaves_as_a_map_alone(tmp_path: Path, command: Command) -> None:
    points = drift(1)
    source = tmp_path / "b.ply"
    write_ply_points(source, points, {"intensity": np.arange(len(points), dtype=np.float32)})
    for name, *options in (
        ("w.mcap",), ("w.bag",), ("w.tum",), ("w.kitti",), ("w.pcap",), ("w.osf",), ("w.rrd",), ("w", "--to", "ros2"),
        ("w", "--to", "semantic-kitti"), ("w", "--to", "pcd"),
    ):  # fmt: skip
        refused(
            command("convert", source, tmp_path / name, *options),
            f"{source}: a map without its scans has no poses or times: name a new .laz or .ply",
        )
    refused(command("convert", source, tmp_path / "w", "--quiet"), "a map without its scans is no session")
    assert [path.name for path in tmp_path.iterdir()] == ["b.ply"]
    said = convert(command, source, tmp_path / "w.ply", "--cell", "0.01")
    assert " stations, without truth, " in said
    found, scalars = read_ply(tmp_path / "w.ply", ("intensity", "time", "scan"))
    assert list(scalars) == ["intensity"]
    assert len(found) > 0.9 * len(points)
    np.testing.assert_allclose(found, points[scalars["intensity"].astype(int)], atol=1e-4)


def test_a_merged_e57_has_no_poses_to_write(tmp_path: Path, command: Command) -> None:
    pytest.importorskip("pye57", reason="pip install 'tunnelcd[formats]'")
    source = write_merged_e57(tmp_path / "b.e57", drift(1).astype(np.float64))
    for name in ("w.kitti", "w.tum"):
        refused(command("convert", source, tmp_path / name), f"{source}: a map without its scans has no poses or times")
    assert [path.name for path in tmp_path.iterdir()] == ["b.e57"]


def test_a_session_far_out_is_no_pcd(
    pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
    shutil.copytree(pair / "before", tmp_path / "s")
    poses = read_session(pair / "before").odom_T_sensor.copy()
    for far_m, is_refused in ((5.2e6, True), (50_000.0, False)):
        poses[:, 1, 3] += far_m - poses[0, 1, 3]
        np.savez(tmp_path / "s" / "odometry.npz", allow_pickle=False, odom_T_sensor=poses)
        result = command("convert", tmp_path / "s", tmp_path / "out")
        if is_refused:
            refused(result, "32-bit numbers of PCD are off by up to 0.25 m: convert the recording to a session again")
            assert not (tmp_path / "out").exists()
        else:
            assert result[0] == 0
    result = command("convert", tmp_path / "s", tmp_path / "a.laz", "--origin", "0,5000000,0")
    refused(result, "leave --origin out: it is subtracted where a recording becomes a session")


def test_a_session_of_a_story_leaves_without_truth_about_changes(pair: Path, tmp_path: Path, command: Command) -> None:
    story = tmp_path / "story"
    shutil.copytree(pair / "before", story / "session-01")
    (story / "story.json").write_text("{}")
    said = convert(command, story / "session-01", tmp_path / "a.ply", "--with-truth", "--cell", "0.2")
    assert "with truth as field instance, " in said
    assert set(read_ply(tmp_path / "a.ply", ("change", "instance"))[1]) == {"instance"}
    convert(command, story / "session-01", tmp_path / "a.tum", "--with-truth")
    assert (tmp_path / "a.true.tum").is_file()
    for name, *options in (("w",), ("w", "--to", "semantic-kitti"), ("w.rrd",)):
        refused(
            command("convert", story / "session-01", tmp_path / name, "--with-truth", *options),
            "is that of a pair: make one, `tunnelcd pair STORY 1 2 --out PAIR`, or leave --with-truth out",
        )
    shutil.copytree(pair / "before", tmp_path / "copied")  # a pair's session: its labels are right
    said = convert(command, tmp_path / "copied", tmp_path / "b.ply", "--with-truth", "--cell", "0.2")
    assert "with truth as fields change and instance, " in said
    osf = pytest.importorskip("ouster.sdk.osf", reason="pip install 'tunnelcd[ouster]'")
    said = convert(command, story / "session-01", tmp_path / "a.osf", "--with-truth")
    assert "with truth as field INSTANCE, " in said
    with osf.OsfFrameSetSource(str(tmp_path / "a.osf")) as source:
        fields = set(next(iter(source))[0].fields)
    assert "INSTANCE" in fields and "LABEL" not in fields


def test_packets_and_their_metadata_have_two_names(pair: Path, tmp_path: Path, command: Command) -> None:
    pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
    out = tmp_path / "x.json"
    refused(command("convert", pair / "before", out, "--to", "pcap"), f"{out}: the name of the file that is written")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_line_and_leaves_nothing(pair: Path, tmp_path: Path, command: Command) -> None:
    resource = pytest.importorskip("resource", reason="no limits on files here")
    pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")
    pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
    own = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, own[1]))
    try:
        for name, *options in (
            ("a.mcap",),
            ("b", "--to", "ros2"),
            ("c.pcap",),
            ("d.laz",),
            ("e", "--to", "semantic-kitti"),
        ):
            out = tmp_path / "new" / name
            refused(command("convert", pair / "before", out, "--quiet", *options), f"error: {out}: cannot ")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, own)
    assert list(tmp_path.iterdir()) == []
