"""Recordings of every kind as worlds of pairs, by the command line and from Python."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import invert, transform
from cdpipe.io.foreign import HowToRead
from cdpipe.io.out.scans import START_NS, Outgoing
from cdpipe.io.ply import write_ply_points
from cdpipe.io.readers import RecordedScans, open_session
from cdpipe.io.session import read_session
from cdpipe.model.types import PosedScan
from cdpipe.pipeline import detect
from cdpipe.training.shard import read_shard
from eval.core.output import new_folder
from eval.graft import making
from eval.graft.adapters import list_adapters, locate_recording
from eval.graft.clouds import as_session
from eval.graft.making import fill_pair, make_pair
from eval.scoring import score
from eval.training import Recipe, make_shard
from scenarios.grafted import GraftScenario, Recording
from scenarios.library import load_scenario
from scenarios.schema import Prop, Scenario
from sim.session.truth import read_pair_truth, read_true_poses

SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")
SEED = 10003
Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def simulated(simulated_once: Callable[[Scenario, int], Path]) -> Path:
    return simulated_once(load_scenario("smoke/unchanged", SEED, SMALL), SEED)


def graft(*sessions: Path, props: tuple[Prop, ...] = (), **override: object) -> GraftScenario:
    recording = Recording(sessions=tuple(map(str, sessions)), **{"reach_m": 4.0, "clearance_m": 0.5, **override})
    return GraftScenario(family="test", props=props, recording=recording)


def boxes(n: int) -> tuple[Prop, ...]:
    return tuple(Prop(name=f"box-{k}", kind="box", size_m=(0.8, 0.7, 0.7), change="added") for k in range(n))


def test_what_is_grafted_is_found_and_the_null_pair_is_silent(simulated: Path, tmp_path: Path) -> None:
    found = {}
    for name, props in (("changed", boxes(2)), ("null", ())):
        pair = tmp_path / name
        make_pair(graft(simulated / "before", props=props, split="alternate"), SEED, pair)
        report = detect(pair / "before", pair / "after", "every-keyframe", before_T_after=np.eye(4))
        found[name] = score(report, pair)
    assert found["changed"]["region_recall"] == 1
    assert found["changed"]["object_iou_point"] > 0.6
    assert found["changed"]["merge_error_m"] < 0.02
    assert found["null"]["false_regions_per_100m"] == 0


def test_two_recordings_are_merged_by_tunnelcd_where_no_merge_is_given(simulated: Path, tmp_path: Path) -> None:
    make_pair(graft(simulated / "before", simulated / "after"), SEED, tmp_path / "pair")
    truth = read_pair_truth(tmp_path / "pair").graft
    assert truth is not None
    assert (truth["merge_from"], truth["split"]) == ("tunnelcd", "two recordings")
    odom = [read_session(simulated / name).odom_T_sensor[0] for name in ("before", "after")]
    world = [read_true_poses(simulated / name)[0] for name in ("before", "after")]
    true = odom[0] @ invert(world[0]) @ world[1] @ invert(odom[1])
    np.testing.assert_allclose(truth["before_T_after"], true, atol=0.05)


def test_one_recording_named_twice_is_refused(simulated: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one and the same recording: name it once"):
        make_pair(graft(simulated / "before", simulated / "before"), SEED, tmp_path / "pair")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["drive.osf", "drive.pcap"])
def test_messages_name_the_file_of_a_recording_that_is_imported(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def import_simulated(path: Path, out: Path, how: HowToRead, report: object) -> None:
        shutil.copytree(simulated / "before", out)

    monkeypatch.setattr(making, "import_ouster", import_simulated)
    (tmp_path / name).write_bytes(b"stands for packets")
    scenario = graft(tmp_path / name, split="passes", format=Path(name).suffix[1:])
    with pytest.raises(InputError, match=rf"^{re.escape(str(tmp_path / name))}: "):
        make_pair(scenario, SEED, tmp_path / "pair")
    with making.open_recorded(scenario.recording) as recorded:
        (session,) = recorded.sessions
        given = read_session(simulated / "before")
        np.testing.assert_array_equal(session.chunk(0).range_mm, given.chunk(0).range_mm)


def write_scans(session: Path, folder: Path, command: Command) -> Path:
    """Write a session as PCD files and read them back as recorded by somebody else."""
    pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
    assert command("convert", session, folder, "-q")[0] == 0
    return folder


def test_bare_points_are_rays_to_the_millimetre(simulated: Path, tmp_path: Path, command: Command) -> None:
    source = open_session(write_scans(simulated / "before", tmp_path / "scans", command))
    session = as_session(source)
    again = RecordedScans(session)
    for index in (0, 3):
        points, made = source.scan(index).points_sensor, again.scan(index).points_sensor
        assert len(points) == len(made)
        assert np.abs(points - made).max() < 6e-4
        off = np.cross(points, made) / np.linalg.norm(points, axis=1, keepdims=True)
        assert np.linalg.norm(off, axis=1).max() < 2e-5  # across the ray


@pytest.mark.parametrize(
    ("shone", "expected"),
    [
        ([[0.0, 0.25], [1.0, np.nan]], [[0, 64], [255, 0]]),  # shares of 1
        ([[0.0, 1.0], [1.0, 0.0]], [[0, 1], [1, 0]]),
        ([[-3.0, 17.4], [254.6, 100.0]], [[0, 17], [255, 100]]),
        ([[0.0, 256.0], [400.0, 510.0]], [[0, 128], [200, 255]]),
        ([[0.0, 65535.0], [512.0, np.inf]], [[0, 255], [2, 255]]),  # 16 bits
        ([None, [3.0, 4.0]], [[0, 0], [3, 4]]),
    ],
)
def test_intensities_of_bare_points_are_reflectivities(
    shone: list[list[float] | None], expected: list[list[int]]
) -> None:
    source = Bare(shone)
    session = as_session(source)
    chunk = session.chunk(0)
    assert chunk.reflectivity[:, 0].tolist() == expected
    assert not chunk.signal.any()
    for index, scan in enumerate(RecordedScans(session).scans()):
        assert scan.intensity is not None
        assert scan.intensity.tolist() == expected[index]


class Bare:
    """Scans of two bare points each, with intensities."""

    name, descriptors_in, is_temporary = "bare", None, False

    def __init__(self, shone: list[list[float] | None]) -> None:
        self.shone, self.odom_T_sensor = shone, np.tile(np.eye(4), (len(shone), 1, 1))

    def scan(self, index: int) -> PosedScan:
        points = np.array([[1.0 + index, 0.0, 0.0], [0.0, 2.0 + index, 0.0]])
        told = self.shone[index]
        intensity = None if told is None else np.array(told, np.float32)
        stamps_ns = np.full(2, index * 10**8)
        return PosedScan(index, points, np.eye(4), stamps_ns, np.arange(2, dtype=np.int32), intensity=intensity)

    def scans(self) -> Iterator[PosedScan]:
        return (self.scan(index) for index in range(len(self.shone)))


def test_a_map_without_its_scans_is_no_recording_to_graft_into(tmp_path: Path, command: Command) -> None:
    around, along = np.meshgrid(np.linspace(0, 2 * np.pi, 90), np.arange(0, 30, 0.2))
    points = np.stack([along, 2.5 * np.cos(around), 2.5 * np.sin(around)], axis=-1).reshape(-1, 3)
    write_ply_points(tmp_path / "map.ply", points, {})
    code, _, err = command("graft", tmp_path / "map.ply", "--out", tmp_path / "pair")
    assert code == 2
    assert "map.ply: a map without its scans has no rays to cast along" in err
    assert [path.name for path in tmp_path.iterdir()] == ["map.ply"]


def test_props_are_cast_into_bare_points(simulated: Path, tmp_path: Path, command: Command) -> None:
    scans = write_scans(simulated / "before", tmp_path / "scans", command)
    make_pair(graft(scans, props=boxes(1), split="alternate"), SEED, tmp_path / "pair")
    truth = read_pair_truth(tmp_path / "pair")
    assert truth.changes[0].is_observable
    assert truth.graft is not None
    assert not any(truth.graft["noise"][0]["n_gaps"])
    opened = open_session(tmp_path / "pair" / "before")
    was = np.concatenate(
        [transform(each.odom_T_sensor, each.points_sensor) for each in open_session(scans).scans()][::2]
    )
    now = np.concatenate([transform(each.odom_T_sensor, each.points_sensor) for each in opened.scans()])
    np.testing.assert_allclose(now, was, atol=6e-4)  # nothing stands in the before session


def test_every_public_recording_says_where_it_is_from(tmp_path: Path) -> None:
    adapters = list_adapters()
    assert {"conslam", "geode-metro", "hilti-2023", "min3d-underground", "ntnu-fog", "ntnu-tunnel", "subiaco"} <= set(
        adapters
    )
    assert {adapters[name].licence for name in ("ntnu-fog", "ntnu-tunnel")} == {"BSD-3-Clause (of the repository)"}
    for name, adapter in adapters.items():
        assert adapter.url.startswith("https://")
        assert bool(adapter.sessions) != bool(adapter.unreadable)
        if adapter.unreadable:
            with pytest.raises(InputError, match=f"--recording {name}: .*{adapter.url}"):
                locate_recording(name, tmp_path)
            continue
        with pytest.raises(InputError, match=f"--recording {name}: no .*: fetch and unpack .*licence"):
            locate_recording(name, tmp_path)
        for part in adapter.sessions:
            (tmp_path / part).mkdir(exist_ok=True)
        Recording.model_validate(locate_recording(name, tmp_path))


def test_the_command_line(simulated: Path, tmp_path: Path, command: Command) -> None:
    props = tmp_path / "props.yaml"
    props.write_text("props:\n  - {name: box, kind: box, size_m: [0.8, 0.6, 0.7], change: added}\n")
    told = ("--seed", SEED, "--reach", "4", "--clearance", "0.5", "--out")
    code, out, _ = command("graft", simulated / "before", "--objects", props, *told, tmp_path / "pair")
    assert code == 0
    assert "every other revolution of one recording" in out
    assert "1 change, 1 observable" in out
    assert command("score", tmp_path / "pair", tmp_path)[0] == 2  # there is no answer; the pair itself is read
    code, out, _ = command("graft", simulated / "before", "--out", tmp_path / "null")
    assert (code, "a real pair without changes" in out) == (0, True)
    code, out, _ = command("graft", simulated / "before", simulated / "after", "--out", tmp_path / "two")
    assert (code, "the pair is taken as unchanged: what did change between the recordings" in out) == (0, True)
    own = tmp_path / "own.yaml"
    own.write_text(
        f"recording: {{sessions: [{simulated / 'before'}], reach_m: 4, clearance_m: 0.5}}\n{props.read_text()}"
    )
    assert command("simulate", own, "--seed", SEED, "--out", tmp_path / "simulated", "-q")[0] == 0
    read = [(tmp_path / name / "after" / "chunks" / "00000.npz").read_bytes() for name in ("pair", "simulated")]
    assert read[0] == read[1]
    assert command("view", own, "--html", tmp_path / "v.html")[0] == 2


def test_a_plan_names_the_file_of_a_recording(
    simulated: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "drive").symlink_to(simulated / "before")
    (tmp_path / "own.yaml").write_text(
        "recording: {sessions: [recordings/drive], reach_m: 4, clearance_m: 0.5}\n"
        "props:\n  - {name: box, kind: box, size_m: [0.8, 0.6, 0.7], change: added}\n"
    )
    plan = tmp_path / "plan.yaml"
    plan.write_text(f"name: drive\nscenarios: [own.yaml]\nseeds: [{SEED}]\nvariants: [{{preset: random-regions}}]\n")
    code, _, err = command("run", plan, "--out", tmp_path / "run")
    assert code == 0, err
    (row,) = pd.read_csv(tmp_path / "run" / "results.csv").to_dict("records")
    assert (row["scenario"], row["status"], row["n_observable"]) == ("own.yaml", "ok", 1)


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        ((), "0 recordings: expected one"),
        (("{s}", "{s}", "{s}"), "3 recordings: expected one"),
        (("{s}", "--objects", "no-such"), "no-such"),
        (("{s}", "--split", "passes"), "no way is driven twice"),
        (("{s}", "{t}", "--split", "halves"), "--split halves: splits one recording, and there are 2: leave it out"),
        (("{s}", "--before-T-after", "m.txt"), "--before-T-after m.txt: "),
        (("{s}", "--reach", "2", "--clearance", "2.5"), "--reach 2: "),
        (("{s}", "--odometry", "kiss-icp"), "a session has its own poses"),
        (("{s}", "--origin", "1,2,3"), "a session has its own poses"),
        (("{s}", "--root", "x"), "--root: it holds the files of a public recording"),
        (("{s}/nowhere",), "no such file"),
        (("--recording", "conslm"), 'did you mean "conslam"'),
        (("--recording", "conslam"), "give --root DIR"),
    ],
)
def test_what_cannot_be_grafted_is_one_line(
    argv: tuple[str, ...], told: str, simulated: Path, tmp_path: Path, command: Command
) -> None:
    words = [word.format(s=simulated / "before", t=simulated / "after") for word in argv]
    code, _, err = command("graft", *words, "--out", tmp_path / "pair", "-q")
    assert code == 2
    assert told in err
    assert len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_scans_of_bare_points_leave_as_they_are_and_not_as_a_sweep(simulated: Path) -> None:
    session = as_session(open_session(simulated / "before"))
    source = RecordedScans(session)
    whole, swept = (list(read(lambda *_: None)) for read in (Outgoing(source).scans, Outgoing(source).sweeps))
    for one, other in zip(whole, swept, strict=True):
        np.testing.assert_array_equal(other.points, one.points)
        assert other.offset_ns is None and len(other.path_ns) == 1


def test_a_clock_that_begins_at_0_tells_no_time(simulated: Path) -> None:
    session = read_session(simulated / "before")
    first_ns = int(session.chunk(0).column_stamps_ns[0, 0])
    for start_ns, told in ((0, START_NS), (7, 7), (None, START_NS)):
        given = {} if start_ns is None else {"sensor_clock_start_ns": start_ns}
        outgoing = Outgoing(RecordedScans(replace(session, provenance=given)))
        assert next(outgoing.sweeps(lambda *_: None)).stamp_ns == first_ns + told
        assert outgoing.start_ns == (told if start_ns is None else start_ns)


def test_a_shard_of_a_dataset_is_made_of_a_recording(simulated: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(
        f"recording: {{sessions: [{simulated / 'before'}], reach_m: 4, clearance_m: 0.5}}\n"
        "props:\n  - {name: box, kind: box, size_m: [0.8, 0.6, 0.7], change: added}\n"
    )
    (tmp_path / "one.safetensors").write_bytes(make_shard(str(own), SEED, Recipe(draws=1)))
    arrays, about = read_shard(tmp_path / "one.safetensors")
    assert about["is_recorded"]
    assert about["changes"] == [{"name": "box", "prop_kind": "box"}]
    assert arrays["change_is_observable"].tolist() == [True]
    n_scans = read_session(simulated / "before").n_scans
    assert arrays["before_scans"].max() < n_scans / 2  # every other revolution is of the after session
    assert len(arrays["before_images"]) == about["counts"]["n_before"] > 0
    assert len(arrays["after_scans"]) == about["counts"]["n_after"] > 0
    assert about["counts"]["n_positive"] > 0
    assert set(np.unique(arrays["labels"])) == {-1, 0, 1}


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
@pytest.mark.parametrize("is_nested", [False, True])
def test_two_pairs_are_not_written_into_one_folder(tmp_path: Path, is_nested: bool) -> None:
    scenario = load_scenario("smoke/unchanged", SEED, ["sensor.mode=512x10", "platform.scan_spacing_m=8.0"])
    out, refused = tmp_path / "pair", []

    def begin_another(stage: str, _done: int, _total: int) -> None:
        if stage in ("before", "after"):
            with pytest.raises(InputError, match=r"pair: another `tunnelcd` writes there"), new_folder(out):
                pass
            with pytest.raises(InputError, match=r"pair: another `tunnelcd` writes there"):
                make_pair(scenario, SEED + 1, out)
            refused.append(stage)

    if is_nested:  # as `tunnelcd simulate` does
        with new_folder(out) as partial:
            fill_pair(scenario, SEED, partial, begin_another)
    else:
        make_pair(scenario, SEED, out, begin_another)
    assert {"before", "after"} <= set(refused)
    assert {path.name for path in out.iterdir()} == {"before", "after", "truth"}
    assert [path.name for path in tmp_path.iterdir()] == ["pair"]
