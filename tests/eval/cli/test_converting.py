from __future__ import annotations

import gc
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import transform
from cdpipe.io.readers import open_session
from cdpipe.io.session import Session, SessionWriter, read_session
from eval.cli.commands import converting
from eval.cli.main import main
from eval.truth.scoring_points import build_scoring_points
from sim.session.truth import read_labels, read_pair_truth

pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
from ouster.sdk import osf

Result = tuple[int, str, str]
Command = Callable[..., Result]
SMALL = ("--world", "sensor.mode=512x10", "--world", "platform.scan_spacing_m=1.0")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "pair"
    with pytest.raises(SystemExit) as caught:
        main(["simulate", "smoke/one_box", "--seed", "5", "--out", str(out), "--quiet", *SMALL])
    assert not caught.value.code
    return out


def frames_of(path: Path) -> list[Any]:
    with osf.OsfFrameSetSource(str(path)) as source:
        return [frames[0] for frames in source]


def refused(result: Result, expected: str) -> None:
    code, out, err = result
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert (code, out, len(lines)) == (2, "", 1)
    assert expected in lines[0]


def test_a_simulated_session_leaves_with_its_truth_on_demand(pair: Path, tmp_path: Path, command: Command) -> None:
    path = tmp_path / "new" / "after.osf"
    code, out, err = command("convert", pair / "after", path, "--with-truth")
    session = read_session(pair / "after")
    assert (code, err.splitlines()) == (0, ["  write"])
    assert out.startswith(f"{path}: {session.n_scans} revolutions, with truth as fields LABEL and INSTANCE, ")
    instance, change = next(read_labels(pair / "after", session.n_chunks))
    frames = frames_of(path)
    assert len(frames) == session.n_scans
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.field("LABEL"), change[number])
        np.testing.assert_array_equal(frame.field("INSTANCE"), instance[number])
    assert (instance < 0).any()  # negative labels are kept as they are
    assert (change > 0).any()


def test_truth_stays_behind_by_default(pair: Path, tmp_path: Path, command: Command) -> None:
    shutil.copytree(pair / "after", tmp_path / "told")
    document = json.loads((tmp_path / "told" / "session.json").read_text())
    document["provenance"]["sensor_profile"] = "/home/nobody/gallery/os1.json"
    (tmp_path / "told" / "session.json").write_text(json.dumps(document))
    for number, options in enumerate(((), ("--without-truth",))):
        path = tmp_path / f"{number}.osf"
        code, out, _ = command("convert", tmp_path / "told", path, *options)
        assert (code, "without truth" in out) == (0, True)
        frames = frames_of(path)
        assert set(frames[0].fields) == {"RANGE", "REFLECTIVITY", "SIGNAL"}
        assert json.loads(frames[0].sensor_info.user_data) == {
            "tunnelcd": {"made_by": "tunnelcd simulate", "session": "after"}
        }
    shutil.rmtree(tmp_path / "told" / "truth")
    refused(command("convert", tmp_path / "told", tmp_path / "b.osf", "--with-truth"), "leave --with-truth out")


def test_a_pair_there_and_back_gives_the_same_answer(pair: Path, tmp_path: Path, command: Command) -> None:
    for name in ("before", "after"):
        assert command("convert", pair / name, tmp_path / f"{name}.osf", "--quiet")[0] == 0
        code, out, _ = command("convert", tmp_path / f"{name}.osf", tmp_path / "back" / name)
        assert code == 0
        assert out.endswith("OS-1-32-U, 512x10, poses: own\n")
        for one, other in zip(
            open_session(pair / name).scans(), open_session(tmp_path / "back" / name).scans(), strict=True
        ):
            np.testing.assert_allclose(one.points_sensor, other.points_sensor, atol=1e-5)
            np.testing.assert_array_equal(one.pixels, other.pixels)
            np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    methods = ("--preset", "voxel-diff", "--set", "query.threshold=0", "--set", "regions.min_points=8", "--quiet")
    for source, out in ((pair, "one"), (tmp_path / "back", "other")):
        assert command("detect", source / "before", source / "after", "--out", tmp_path / out, *methods)[0] == 0
    one, other = (
        np.genfromtxt(tmp_path / name / "regions.csv", delimiter=",", skip_header=1) for name in ("one", "other")
    )
    np.testing.assert_allclose(one, other, atol=1e-3)
    assert one.size > 0


def test_what_is_left_out_is_told(pair: Path, tmp_path: Path, command: Command) -> None:
    assert command("convert", pair / "before", tmp_path / "whole.osf", "--quiet")[0] == 0
    frames = frames_of(tmp_path / "whole.osf")
    frames[3].status[:300] = 0
    with osf.Writer(str(tmp_path / "part.osf"), frames[0].sensor_info) as writer:
        for frame in frames:
            writer.save(0, frame)
    code, out, _ = command("convert", tmp_path / "part.osf", tmp_path / "s")
    assert code == 0
    assert f"session of {len(frames) - 1} revolutions" in out
    assert out.endswith("poses: own; 1 left out, of which half the columns or fewer arrived\n")


def test_detect_reads_recordings_without_convert(
    pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "a.osf").write_bytes(b"")
    refused(command("detect", tmp_path / "a.osf", pair / "after", "--out", tmp_path / "out"), "a.osf: not an OSF file")
    for name in ("before", "after"):
        assert command("convert", pair / name, tmp_path / f"{name}.osf")[0] == 0
    made = {}
    for source, suffix in ((pair, ""), (tmp_path, ".osf")):
        sessions = [source / f"{name}{suffix}" for name in ("before", "after")]
        code, _, err = command("detect", *sessions, "--out", tmp_path / f"out{suffix}")
        assert code == 0
        assert err.count("keeps it") == (2 if suffix else 0)
        made[suffix] = pd.read_csv(tmp_path / f"out{suffix}" / "objects.csv")
    assert len(made[""])
    pd.testing.assert_frame_equal(made[""], made[".osf"], rtol=1e-6)
    gc.collect()
    assert not list((tmp_path / "tmp").iterdir())


def test_names_and_options_that_do_not_go_together(pair: Path, tmp_path: Path, command: Command) -> None:
    there = tmp_path / "there.osf"
    there.write_bytes(b"mine")
    before = pair / "before"
    for arguments, expected in (
        ((tmp_path / "none", tmp_path / "a.osf"), "no such file or folder: expected a session, or a recording"),
        ((pair / "truth" / "changes.json", tmp_path / "a"), "expected a session folder, or a recording (.ply, .pcd"),
        ((pair, tmp_path / "a.osf"), f"a pair of sessions: convert {before} and {pair / 'after'} one by one"),
        ((tmp_path, tmp_path / "b"), "no scans in it"),
        ((before, tmp_path / "a.bin"), "a new file that ends in .osf"),
        ((before, there), "there.osf exists already"),
        ((before, there / "a.osf"), "cannot write there"),
        ((before, tmp_path / "a.osf", "--odometry", "kiss-icp"), "leave --odometry out"),
        ((before, tmp_path / "a.osf", "--metadata", "m.json"), "leave --metadata out"),
        ((before, tmp_path / "a", "--format", "kitti"), "(the format that is written is --to): leave --format out"),
        ((before, pair / "after", there, tmp_path / "m.laz", "--seed", "3"), "leave --seed and --world out"),
        ((before, tmp_path / "a.osf", "--origin", "1,2,3"), "leave --origin out"),
        ((before, tmp_path / "a.osf", "--no-deskew"), "leave --no-deskew out"),
        ((there, tmp_path / "b", "--topic", "/x"), "--topic: "),
        (("smoke/one_box", tmp_path / "w.glb", "--world", "sensor.mod=1"), "--world: sensor.mod = 1: unknown key"),
        (("smoke/one_box", tmp_path / "w.glb", "--with-truth"), "leave --with-truth out"),
        (
            (there, tmp_path / "b.osf"),
            f"only a session folder becomes Ouster OSF: make one of it first, `tunnelcd convert {there}",
        ),
        ((before, pair / "after", there, tmp_path / "m.mcap"), "an answer becomes a map with scalar fields: name"),
        ((there, tmp_path, "--odometry", "kiss-icp"), f"{tmp_path}: is not empty"),
        ((before, tmp_path / "a.osf", "--cell", "0.1"), "a.osf: --cell 0.1 is of maps (.laz, .las, .ply): leave it"),
        ((before, pair / "after", there, tmp_path / "m.laz", "--cell", "inf"), "--cell"),
        ((before, pair / "after", there, tmp_path / "m.laz", "--cell", "1e308"), "--cell"),
        ((before, pair / "after", there, tmp_path / "m.laz", "--cell", "nan"), "--cell"),
        ((there, tmp_path / "b", "--cell", "0.1"), "b: --cell 0.1 is of maps"),
        ((there, tmp_path / "b", "--with-truth"), "leave --with-truth out"),
        ((there, tmp_path / "new" / "b"), "there.osf: not an OSF file"),
        ((there, tmp_path / "b", "--odometry", "lio"), "--odometry lio: expected kiss-icp"),
    ):
        refused(command("convert", *arguments), expected)
    assert there.read_bytes() == b"mine"
    assert [path.name for path in tmp_path.iterdir()] == ["there.osf"]


@pytest.mark.parametrize("way", ["out", "in"])
def test_an_interrupt_leaves_nothing(
    way: str, pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    if way == "out":
        monkeypatch.setattr(Session, "chunk", interrupted)
        source, target = pair / "before", tmp_path / "new" / "a.osf"
    else:
        source, target = tmp_path.parent / "whole.osf", tmp_path / "new" / "a"
        converting.convert([pair / "before"], source, quiet=True)
        monkeypatch.setattr(SessionWriter, "add", interrupted)
    assert command("convert", source, target, "--quiet") == (130, "", "interrupted; nothing half-written is left\n")
    source.with_name("whole.osf").unlink(missing_ok=True)
    assert list(tmp_path.iterdir()) == []


def test_a_session_becomes_pcd_files_with_what_moves(tmp_path: Path, command: Command) -> None:
    pypcd4 = pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
    walker = "movers=[{name: walker, kind: person, path: {length_m: 6}, speed_mps: 1.2, sessions: after}]"
    made = tmp_path / "made"
    assert command("simulate", "smoke/unchanged", "--seed", "3", "--out", made, "--world", walker, *SMALL)[0] == 0
    source, out = made / "after", tmp_path / "pcds"
    code, said, _ = command("convert", source, out, "--with-truth")
    assert code == 0
    session = read_session(source)
    assert said.startswith(f"{out}: {session.n_scans} revolutions, and what moves is 1 in gt_cloud.pcd, ")
    assert sorted(path.name for path in out.iterdir()) == ["gt_cloud.pcd", "pcd"]
    assert len(list((out / "pcd").iterdir())) == session.n_scans
    reflectivity = next(session.chunks()).reflectivity
    for scan in open_session(source).scans():
        cloud = pypcd4.PointCloud.from_path(out / "pcd" / f"{scan.index:06d}.pcd")
        assert cloud.fields == ("x", "y", "z", "intensity")
        found = cloud.numpy()
        wanted = transform(scan.odom_T_sensor, scan.points_sensor)
        np.testing.assert_allclose(found[:, :3], wanted, atol=1e-5)
        np.testing.assert_array_equal(found[:, 3], reflectivity[scan.index].ravel()[scan.pixels])
        x, y, z, *turn = cloud.metadata.viewpoint
        np.testing.assert_allclose((x, y, z), scan.odom_T_sensor[:3, 3], atol=1e-6)
        rotation = Rotation.from_quat(np.roll(turn, -1)).as_matrix()
        np.testing.assert_allclose(rotation, scan.odom_T_sensor[:3, :3], atol=1e-6)
        if scan.index >= 3:
            break
    truth = pypcd4.PointCloud.from_path(out / "gt_cloud.pcd").numpy()
    points = build_scoring_points(session)
    np.testing.assert_array_equal(truth[:, :3], points.points_odom)
    (mover,) = read_pair_truth(made).movers
    np.testing.assert_array_equal(truth[:, 3], points.instance == mover.instance)
    assert 30 < truth[:, 3].sum() < 0.1 * len(truth)
    assert command("convert", source, tmp_path / "bare")[0] == 0
    assert not (tmp_path / "bare" / "gt_cloud.pcd").exists()
    refused(command("convert", source, out), "name a new or empty folder")
    refused(command("convert", source, tmp_path / "a.pcd"), "a new file that ends in .osf, .pcap, .mcap, .bag")
