import json
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Int64Array
from cdpipe.io.answer import read_answer
from cdpipe.io.readers import open_session
from cdpipe.model.config import DescriptorConfig
from cdpipe.model.types import DescriptorSet, ScanSource
from cdpipe.pipeline import mapping
from eval.cli.commands import training
from eval.cli.inputs import with_surface
from eval.cli.main import main
from eval.graft import making
from eval.plans import cells as plan_cells
from eval.plans.plan import Plan, load_plan
from eval.report import page
from eval.running import runner
from eval.running.pair_run import Tools
from eval.running.runfolder import RunFolder
from scenarios import load_scenario, scenario_names

Result = tuple[int, str, str]
Command = Callable[..., Result]
SMALL = ("--world", "sensor.mode=512x10", "--world", "platform.scan_spacing_m=1.0")
# finds the box with so few returns, which the preset is not tuned for
FINE = ("--preset", "voxel-diff", "--set", "regions.min_points=8", "--set", "query.threshold=0")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small pair, made by the command line."""
    out = tmp_path_factory.mktemp("made") / "new" / "pair"
    with pytest.raises(SystemExit) as caught:
        main(["simulate", "smoke/one_box", "--seed", "20000", "--out", str(out), "--quiet", *SMALL])
    assert not caught.value.code
    return out


@pytest.fixture
def pair(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "pair")
    return tmp_path / "pair"


@pytest.fixture(scope="module")
def recorded(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same pair as folders of PLY scans with a TUM trajectory."""
    root = tmp_path_factory.mktemp("recorded")
    for name in ("before", "after"):
        (root / name).mkdir()
        lines = ["# stamp tx ty tz qx qy qz qw"]
        for scan in open_session(made / name).scans():
            header = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
                f"property float {axis}\n" for axis in "xyz"
            )
            points = scan.points_sensor.astype("<f4")
            (root / name / f"{scan.index:03d}.ply").write_bytes(
                (header.format(len(points)) + "end_header\n").encode() + points.tobytes()
            )
            quaternion = Rotation.from_matrix(scan.odom_T_sensor[:3, :3]).as_quat()
            numbers = [float(scan.index), *scan.odom_T_sensor[:3, 3], *quaternion]
            lines.append(" ".join(f"{number:.9f}" for number in numbers))
        (root / name / "trajectory.txt").write_text("\n".join(lines) + "\n")
    return root


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def assert_refused(result: Result, *words: str) -> None:
    code, _, err = result
    assert code == 2, err
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, err
    assert "Traceback" not in err
    for word in words:
        assert word in errors[0]


def test_simulate_makes_the_pair_of_the_seed(made: Path) -> None:
    assert {"before/session.json", "after/session.json", "truth/changes.json"} <= tree(made)
    assert json.loads((made / "truth" / "changes.json").read_text())["seed"] == 20000
    assert [path.name for path in made.parent.iterdir()] == ["pair"]


def test_detect_writes_its_answer_and_needs_no_truth(pair: Path, tmp_path: Path, command: Command) -> None:
    for folder in pair.rglob("truth"):
        shutil.rmtree(folder)
    code, out, err = command("detect", pair / "before", pair / "after", *FINE, "--out", tmp_path / "out")
    assert (code, "error" in err) == (0, False)
    report = read_answer(tmp_path / "out").report
    assert report is not None
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "answer.json", "answer.npz", "regions.csv", "objects.csv", "objects.ply",
    }  # fmt: skip
    objects = pd.read_csv(tmp_path / "out" / "objects.csv")
    assert objects["n_returns"].tolist() == [len(item.returns) for item in report.objects]
    assert objects["kind"].tolist() == [item.kind for item in report.objects]
    volumes_m3 = [item.shape.volume_m3 for item in report.objects if item.shape]
    assert objects["volume_m3"].tolist() == pytest.approx(volumes_m3)
    assert len(pd.read_csv(tmp_path / "out" / "regions.csv")) == report.regions.is_proposed.sum()
    content = (tmp_path / "out" / "objects.ply").read_bytes()
    vertices = np.frombuffer(content[content.index(b"end_header\n") + 11 :], dtype="<f4,<f4,<f4,<i4")
    assert len(vertices) == objects["n_points"].sum()
    assert np.bincount(vertices["f3"]).tolist() == objects["n_points"].tolist()
    assert "added" in out
    assert "merge: accepted" in out
    inliers = next(line.split() for line in out.splitlines() if "inlier_share" in line)
    assert float(inliers[1]) == pytest.approx(report.evidence["inlier_share"], abs=1e-3)
    assert inliers[3:] == ["yes", "merge.min_inlier_share"]
    assert {"t_merge_s", "t_descriptor_s", "t_cd_s", "t_oe_s"} <= set(report.seconds)


def test_a_silent_detect_says_how_near_the_best_candidate_came(pair: Path, tmp_path: Path, command: Command) -> None:
    silent = ("--preset", "paper", "--site", "wide", "--set", "query.threshold=9")
    code, out, _ = command("detect", pair / "before", pair / "after", *silent, "--out", tmp_path / "out")
    report = read_answer(tmp_path / "out").report
    assert report is not None
    assert code == 0
    assert f"nothing reaches query.threshold = 9; the best of {len(report.regions.scores)} candidates scores" in out
    assert f"{report.regions.scores[0]:.4g}" in out
    assert report.regions.radius_m == 10  # what the preset says of wide drifts


def test_detect_finds_the_box_in_recorded_files_as_in_the_session(
    made: Path, recorded: Path, tmp_path: Path, command: Command
) -> None:
    options = (*FINE, "--quiet")
    assert command("detect", made / "before", made / "after", *options, "--out", tmp_path / "a")[:2] == (0, "")
    assert command("detect", recorded / "before", recorded / "after", *options, "--out", tmp_path / "b")[0] == 0
    ours, theirs = read_answer(tmp_path / "a").report, read_answer(tmp_path / "b").report
    assert ours is not None
    assert theirs is not None
    assert len(ours.regions.scores) >= 1
    np.testing.assert_allclose(ours.regions.centres_map[0], theirs.regions.centres_map[0], atol=0.3)


def test_missing_returns_are_said_once_and_change_no_answer(recorded: Path, tmp_path: Path, command: Command) -> None:
    shutil.copytree(recorded, tmp_path / "organised")
    scan = tmp_path / "organised" / "after" / "003.ply"
    content = scan.read_bytes()
    n, body = int(content.split(b"vertex ")[1].split()[0]), content.index(b"end_header\n") + 11
    scan.write_bytes(content[:body].replace(b"vertex %d" % n, b"vertex %d" % (n + 5)) + content[body:] + bytes(60))
    answers = []
    for name, folder in (("a", recorded), ("b", tmp_path / "organised")):
        code, _, err = command("detect", folder / "before", folder / "after", "--quiet", "--out", tmp_path / name)
        assert code == 0
        told = [line for line in err.splitlines() if "missing returns" in line]
        assert len(told) == (name == "b") and all(line.startswith("warning: ") and " 5 of " in line for line in told)
        answers.append(read_answer(tmp_path / name).report)
    one, other = answers
    assert one is not None and other is not None
    np.testing.assert_array_equal(one.before_T_after, other.before_T_after)
    np.testing.assert_array_equal(one.regions.scores, other.regions.scores)


def test_describe_stores_what_detect_then_uses(
    pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("before", "after"):
        code, out, _ = command("describe", pair / name)
        assert code == 0
        assert str(pair / name / "descriptors" / "3deg.npz") in out
    calls: list[str] = []
    usual = mapping.describe_scans

    def counted(source: ScanSource, chosen: Int64Array, config: DescriptorConfig) -> DescriptorSet:
        calls.extend([source.name] * (len(chosen) > 1))  # one alone warms up
        return usual(source, chosen, config)

    monkeypatch.setattr(mapping, "describe_scans", counted)
    arguments = ("detect", pair / "before", pair / "after", "--quiet", "--out")
    assert command(*arguments, tmp_path / "stored")[0] == 0
    assert calls == []
    # of other weights, or of other keyframes: not used
    stored = pair / "before" / "descriptors" / "3deg.npz"
    with np.load(stored) as arrays:
        np.savez(stored, **{**arrays, "checkpoint": np.array("other")})
    assert command(*arguments, tmp_path / "stale")[0] == 0
    assert calls == [str(pair / "before")]
    assert command(*arguments, tmp_path / "sparse", "--set", "map.keyframe_spacing_m=2")[0] == 0
    assert calls[1:] == [str(pair / "before"), str(pair / "after")]


def test_detect_takes_a_merge_that_is_known(pair: Path, tmp_path: Path, command: Command) -> None:
    detect = ("detect", pair / "before", pair / "after", *FINE)
    assert command(*detect, "--quiet", "--out", tmp_path / "found")[0] == 0
    found = json.loads((tmp_path / "found" / "answer.json").read_text())
    known = ("--before-T-after", tmp_path / "found" / "answer.json", "--set", "merge.refine=none")
    code, out, _ = command(*detect, *known, "--out", tmp_path / "known")
    assert code == 0 and "merge: known, not judged" in out and "is_known" in out
    stored = json.loads((tmp_path / "known" / "answer.json").read_text())
    np.testing.assert_allclose(stored["before_T_after"], found["before_T_after"], atol=1e-9)
    assert (stored["evidence"]["is_known"], "is_known" in found["evidence"]) == (1, False)
    assert command("score", pair, tmp_path / "known", "--quiet")[0] == 0
    aligned = ("--assume-aligned", "--set", "merge.refine=none", "--quiet", "--out", tmp_path / "aligned")
    assert command(*detect, *aligned)[0] == 0
    stored = json.loads((tmp_path / "aligned" / "answer.json").read_text())
    np.testing.assert_array_equal(stored["before_T_after"], np.eye(4))
    code, _, err = command(*detect, "--assume-aligned", *known[:2], "--out", tmp_path / "both")
    assert code == 2 and "give one of them" in err
    (tmp_path / "T.txt").write_text("1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n")
    code, _, err = command(*detect, "--before-T-after", tmp_path / "T.txt", "--out", tmp_path / "bad")
    assert code == 2 and "is not rigid" in err and len(err.splitlines()) == 1
    assert not (tmp_path / "bad").exists()


def test_score_with_swapped_or_missing_folders_says_the_order(tmp_path: Path, command: Command) -> None:
    for path in ("pair/truth/changes.json", "mine/answer.json"):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text("{}")
    pair, mine = tmp_path / "pair", tmp_path / "mine"
    assert_refused(command("score", mine, pair), f"an answer; its pair comes first: `tunnelcd score {pair} {mine}`")
    assert_refused(command("score", pair), f"name an answer to it, too: `tunnelcd score {pair} ANSWER`")
    run = tmp_path / "run"
    (run / "pairs").mkdir(parents=True)
    (run / "provenance.json").write_text("{}")
    assert_refused(command("score", run, mine), f"a run, no pair: name a pair below {run / 'pairs'}")


def test_score_of_one_answer(pair: Path, tmp_path: Path, command: Command) -> None:
    command("detect", pair / "before", pair / "after", *FINE, "--out", tmp_path / "out")
    code, out, _ = command("score", pair, tmp_path / "out")
    row = dict(line.split(None, 1) for line in out.splitlines() if len(line.split(None, 1)) == 2)
    assert (code, row["status"], row["n_changes"], row["region_recall"]) == (0, "ok", "1", "1")
    assert command("score", pair, tmp_path / "out", "--quiet") == (0, "", "")


def edit_poses(session: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    with np.load(session / "odometry.npz") as arrays:
        poses = arrays["odom_T_sensor"]
    np.savez(session / "odometry.npz", odom_T_sensor=change(poses.copy()))


def nan_pose(session: Path) -> None:
    def change(poses: np.ndarray) -> np.ndarray:
        poses[3, 0, 3] = np.nan
        return poses

    edit_poses(session, change)


def one_pose_too_few(session: Path) -> None:
    edit_poses(session, lambda poses: poses[:-1])


def empty_scan(session: Path) -> None:
    path = session / "chunks" / "00000.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["range_mm"][2] = 0
    np.savez(path, **arrays)


def cut_chunk(session: Path) -> None:
    path = session / "chunks" / "00000.npz"
    path.write_bytes(path.read_bytes()[:1000])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (shutil.rmtree, ["after", "no such file or folder"]),
        (lambda session: (session / "session.json").unlink(), ["no scans in it"]),
        (lambda session: (session / "session.json").write_text("{"), ["session.json", "damaged"]),
        (nan_pose, ["odometry.npz", "not finite"]),
        (one_pose_too_few, ["odometry.npz", "one pose for each scan"]),
        (empty_scan, ["scan 2", "no return"]),
        (cut_chunk, ["00000.npz", "damaged or cut short"]),
    ],
)
def test_damaged_sessions_are_refused_and_nothing_is_left(
    pair: Path, tmp_path: Path, command: Command, damage: Callable[[Path], None], words: list[str]
) -> None:
    damage(pair / "after")
    before = tree(tmp_path)
    assert_refused(command("detect", pair / "before", pair / "after", "--out", tmp_path / "x" / "out"), *words)
    assert tree(tmp_path) == before


def nan_in_trajectory(folder: Path) -> None:
    lines = (folder / "trajectory.txt").read_text().splitlines()
    stamp, _, rest = lines[6].split(None, 2)
    lines[6] = f"{stamp} nan {rest}"
    (folder / "trajectory.txt").write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "000.ply").unlink(), ["trajectory.txt", "one line for each scan"]),
        (lambda folder: (folder / "trajectory.txt").unlink(), ["exactly one trajectory"]),
        (lambda folder: (folder / "001.ply").write_text("solid"), ["001.ply", "PLY"]),
        (nan_in_trajectory, ["trajectory.txt:7", "not finite"]),
    ],
)
def test_damaged_recordings_are_refused(
    recorded: Path, tmp_path: Path, command: Command, damage: Callable[[Path], None], words: list[str]
) -> None:
    shutil.copytree(recorded, tmp_path / "files")
    damage(tmp_path / "files" / "before")
    result = command("detect", tmp_path / "files" / "before", tmp_path / "files" / "after", "--out", tmp_path / "out")
    assert_refused(result, *words)
    assert not (tmp_path / "out").exists()


def test_sessions_of_different_tunnels_are_refused(pair: Path, tmp_path: Path, command: Command) -> None:
    elsewhere = tmp_path / "elsewhere"
    wider = ("--world", "tunnel.section.width_m=7", "--world", "tunnel.section.height_m=5")
    assert command("simulate", "smoke/one_box", "--out", elsewhere, "--quiet", *SMALL, *wider)[0] == 0
    before = tree(tmp_path)
    quiet = command("detect", pair / "before", elsewhere / "after", "--out", tmp_path / "out", "--quiet")
    assert_refused(quiet, "cannot be merged", str(elsewhere / "after"))
    code, out, err = command("detect", pair / "before", elsewhere / "after", "--out", tmp_path / "out")
    assert code == 2
    assert err.splitlines()[-1] == quiet[2].splitlines()[-1]
    assert "merge: refused" in out
    assert any({"no", "merge.min_inlier_share"} <= set(line.split()) for line in out.splitlines())
    assert tree(tmp_path) == before


def test_a_session_beside_itself_is_compared_and_it_is_said(pair: Path, tmp_path: Path, command: Command) -> None:
    code, _, err = command("detect", pair / "before", pair / "before", *FINE, "--out", tmp_path / "out", "--quiet")
    same = f"note: {pair / 'before'} and {pair / 'before'} are one and the same recording"
    assert (code, err) == (0, f"{same}: nothing can have changed between them\n")
    report = read_answer(tmp_path / "out").report
    assert report is not None
    assert report.objects == ()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--preset", "papr"], ["preset", 'did you mean "paper"']),
        (["--set", "query.radius=3"], ["query.radius", 'did you mean "query.radius_m"']),
        (["--set", "query.radius_m=-3"], ["query.radius_m = -3", "greater than 0"]),
        (["--set", "query.radius_m"], ["expected key=value"]),
    ],
)
def test_mistaken_settings(made: Path, tmp_path: Path, command: Command, options: list[str], words: list[str]) -> None:
    result = command("detect", made / "before", made / "after", "--out", tmp_path / "out", *options)
    assert_refused(result, *words)
    assert tree(tmp_path) == set()


def test_output_folders_that_cannot_be_used(made: Path, tmp_path: Path, command: Command) -> None:
    full, file = tmp_path / "full", tmp_path / "file"
    full.mkdir()
    (full / "mine").write_text("x")
    file.write_text("x")
    detect = ("detect", made / "before", made / "after", "--out")
    simulate = ("simulate", "smoke/one_box", "--out")
    before = tree(tmp_path)
    for arguments in (detect, simulate):
        assert_refused(command(*arguments, full), str(full), "not empty", "name a new or empty folder")
        assert_refused(command(*arguments, file), str(file), "is a file")
        assert_refused(command(*arguments, file / "below"), "cannot write there")
    for arguments in (("run", "smoke", "--out"), ("demo", "--out")):
        assert_refused(command(*arguments, full), str(full), "not a run folder", "name a new folder")
        assert_refused(command(*arguments, file), str(file), "cannot write there")
    assert tree(tmp_path) == before


def test_unknown_names(tmp_path: Path, command: Command) -> None:
    assert_refused(command("simulate", "smoke/one_bx", "--out", tmp_path / "out"), 'did you mean "smoke/one_box"')
    assert_refused(command("run", "smok", "--out", tmp_path / "out"), 'did you mean "smoke"')
    assert_refused(command("run", "smoke", "--seeds", "9:3", "--out", tmp_path / "out"), "--seeds 9:3")
    assert_refused(command("run", "smoke", "--grid", "extract.voxl_m=1,2", "--out", tmp_path / "out"), "voxel_m")
    assert_refused(command("score", tmp_path / "absent"), "no such run folder")
    assert_refused(command("report", tmp_path), "not a run folder")
    assert_refused(command("check", "smok"), "no plan, scenario or preset")
    assert tree(tmp_path) == set()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["detect"], ["tunnelcd detect: ", "`tunnelcd detect --help`"]),
        (["no-such-command"], ["'no-such-command'"]),
        (
            ["train", "data", "--out"],
            ["tunnelcd train: Option '--out'", "`tunnelcd train --help`"],
        ),
        (["run", "null", "--worker", "2"], ["--worker", "--workers"]),
        (
            ["simulate", "smoke/one_box", "--seed", "-1", "--out", "x"],
            ["tunnelcd simulate: "],
        ),
        (["detect", "a", "b", "--site", "wid", "--out", "x"], ["'wid'"]),
        (["detect", "a", "b", "--world", "query.radius_m=3", "--out", "x"], ["a method is changed by --set"]),
    ],
)
def test_usage_errors_are_one_line(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = command(*arguments)
    assert_refused((code, out, err), *words)
    assert len(err.splitlines()) == 1
    assert tree(tmp_path) == set()


def test_run_score_report_on_one_folder(
    made: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = [word for word in SMALL if word != "--world"]
    small = Tools(draw=lambda name, seed, _: load_scenario(name, seed, settings))
    monkeypatch.setattr(runner, "TOOLS", small)
    plan = tmp_path / "mine.yaml"
    plan.write_text("name: mine\nscenarios: [smoke/one_box]\nseeds: [1]\nvariants: [{preset: voxel-diff}]\n")
    out = tmp_path / "run"
    arguments = ("run", plan, "--seeds", "20000:20001", "--grid", "query.radius_m=3,4.5", "--out", out)
    code, printed, _ = command(*arguments)
    assert (code, "2 cells done, 0 kept" in printed) == (0, True)
    assert "voxel-diff[query.radius_m=4.5]" in printed
    results = pd.read_csv(out / "results.csv")
    assert results["variant"].tolist() == ["voxel-diff[query.radius_m=3]", "voxel-diff[query.radius_m=4.5]"]
    assert set(results["seed"]) == {20000}
    assert "0 cells done, 2 kept" in command(*arguments)[1]
    assert "2 answers scored again" in command("score", out)[1]
    code, printed, _ = command("report", out)
    assert (code, (out / "index.html").is_file()) == (0, True)
    assert str(out / "index.html") in printed


def test_demo_is_the_paper_plan_and_the_page(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def run_plan(plan: Plan, run: RunFolder, **options: Any) -> runner.RunOutcome:
        asked.append((plan.name, options["force"], options["limit"]))
        pd.DataFrame([{"scenario": "a", "seed": 1, "variant": "b", "status": "ok"}]).to_csv(
            run.path / "results.csv", index=False
        )
        return runner.RunOutcome(1, 0, 0)

    monkeypatch.setattr(runner, "run_plan", run_plan)
    monkeypatch.setattr(page, "write_page", lambda folder: folder / "index.html")
    code, printed, _ = command("demo", "--out", tmp_path / "demo")
    assert (code, asked) == (0, [("paper", False, None)])
    assert str(tmp_path / "demo" / "index.html") in printed


def test_list_names_everything(command: Command) -> None:
    code, out, _ = command("list")
    assert code == 0
    words = out.split()
    assert {*scenario_names(), "smoke", "paper", "tunnelcd", "voxel-diff", "os1-32-nominal"} <= set(words)


def test_check_tells_all_mistakes_of_all_files(tmp_path: Path, command: Command) -> None:
    plan, preset, scenario = (tmp_path / f"{name}.yaml" for name in ("plan", "preset", "scenario"))
    plan.write_text("name: x\nscenarios: [smoke/one_bx]\nseeds: [1]\nvariants: [{preset: paper}]\n")
    preset.write_text("extract: {voxl_m: 0.3}\n")
    scenario.write_text("extends: smoke/one_box\nscore_radius: 3\n")
    code, out, err = command("check", "smoke", "paper/site1", "voxel-diff", plan, preset, scenario)
    assert code == 2
    assert f"smoke: a plan of {len(plan_cells.expand_cells(load_plan('smoke')))} cells" in out
    assert "paper/site1: a scenario" in out
    assert "voxel-diff: a preset" in out
    lines = err.splitlines()
    assert len(lines) == 3
    for line, start in zip(lines, (f"{plan}:2", f"{preset}:1", f"{scenario}:2"), strict=True):
        assert line.startswith(f"error: {start}: ")
        assert "did you mean" in line


def test_an_interrupt_says_that_cells_are_kept(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "run_plan", interrupted)
    for arguments in (("run", "smoke"), ("demo",)):
        code, _, err = command(*arguments, "--out", tmp_path / "out", "--quiet")
        assert (code, "finished cells are kept" in err) == (130, True)


@pytest.mark.parametrize("sign", [" ", "="])
@pytest.mark.parametrize(
    ("option", "said"), [("--release", "finished pairs are kept"), ("--unpack", "nothing half-written is left")]
)
def test_an_interrupt_of_a_release_is_told_however_its_option_is_written(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch, option: str, said: str, sign: str
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "_release_or_unpack", interrupted)
    words = ["dataset", *f"{option}{sign}x".split(), "--out", str(tmp_path / "x")]
    monkeypatch.setattr(sys, "argv", ["tunnelcd", *words])
    code, _, err = command(*words)
    assert (code, said in err) == (130, True)


def test_an_interrupt_elsewhere_leaves_nothing_half_written(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(making, "write_pair", interrupted)
    assert command("simulate", "smoke/one_box", "--out", tmp_path / "out", "--quiet") == (
        130, "", "interrupted; nothing half-written is left\n",
    )  # fmt: skip
    assert tree(tmp_path) == set()


def test_a_plan_whose_cells_are_refused_leaves_no_folder(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(_: Plan) -> None:
        raise InputError("settings that contradict each other")

    monkeypatch.setattr(plan_cells, "expand_cells", refused)
    assert_refused(command("run", "smoke", "--out", tmp_path / "out"), "contradict")
    assert tree(tmp_path) == set()


def test_a_bug_keeps_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bug(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(runner, "run_plan", bug)
    with pytest.raises(ZeroDivisionError, match="a bug"):
        main(["run", "smoke", "--out", str(tmp_path / "out"), "--quiet"])


def test_help_loads_nothing_heavy() -> None:
    script = (
        "import sys\n"
        "from eval.cli.main import main\n"
        "try:\n    main(['--help'])\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "heavy = {'numpy', 'torch', 'pandas', 'mujoco', 'scipy', 'matplotlib', 'pydantic'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("demo", "simulate", "describe", "detect", "score", "run", "report", "list", "check"):
        assert name in done.stdout


@pytest.mark.parametrize(
    ("program", "arguments", "words"),
    [
        ("calibrate", ["absent"], ["absent/results.csv", "missing", "name a folder"]),
        ("calibrate", ["empty"], ["empty/results.csv", "missing", "name a folder"]),
        ("calibrate", ["damaged"], ["damaged/results.csv", "no rows", "name a folder"]),
        ("calibrate", ["absent", "--quick"], ["--quick", "--help`"]),
        ("merge_gates", ["absent"], ["'--out'"]),
    ],
)
def test_programs_tell_mistakes_as_the_commands_do(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    program: str,
    arguments: list[str],
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "results.csv").touch()
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", [program, *arguments])
    # another test of this process may have imported it, which runpy warns of
    monkeypatch.delitem(sys.modules, f"eval.studies.{program}", raising=False)
    with pytest.raises(SystemExit) as caught:
        runpy.run_module(f"eval.studies.{program}", run_name="__main__")
    out, err = capsys.readouterr()
    assert_refused((int(caught.value.code or 0), out, err), *words)


def test_surface_keeps_the_method_that_a_preset_or_a_setting_names(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("surface: {method: c2c}\n")
    assert with_surface(str(mine), [], "narrow") == []
    assert with_surface("tunnelcd", ["surface.method=c2m"], "narrow") == ["surface.method=c2m"]
    assert with_surface("tunnelcd", [], "narrow") == ["surface.method=planes"]
    with pytest.raises(InputError, match=r"surface\.method=none: displacement is to be measured"):
        with_surface("tunnelcd", ["surface.method=none"], "narrow")
