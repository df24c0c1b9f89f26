"""Blind copies of a run's sessions: nothing in them tells world, seed or truth, and answers find their pairs again."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.io.readers import open_session
from eval.running import export, predictions
from eval.running.export import export_blind, export_with_truth, name_blindly
from eval.running.predictions import evaluate
from eval.running.runfolder import RunFolder, write_json
from eval.scoring.scoring import METRICS_VERSION
from eval.truth.ground_truth import load_ground_truth
from sim.session.truth import read_pair_truth, read_true_poses

Command = Callable[..., tuple[int, str, str]]
WORLD, SEEDS = "sealed/gallery[platform.speed_mps=0.5]", (20417, 20418)
PROFILE = "/home/nobody/sealed-gallery/os1.json"


@pytest.fixture
def run(tmp_path: Path, tiny_pair: Path) -> RunFolder:
    """A run of two pairs whose session.json, folders and times tell what they are, with a stored descriptor beside."""
    folder = RunFolder(tmp_path / "run")
    write_json(folder.path / "provenance.json", {"tool": "tunnelcd", "plan": {"name": "by hand"}})
    document = json.loads((tiny_pair / "truth" / "changes.json").read_text())
    for seed in SEEDS:
        pair = folder.pair(WORLD, seed)
        shutil.copytree(tiny_pair, pair)
        write_json(pair / "truth" / "changes.json", {**document, "family": "sealed/gallery", "seed": seed})
        load_ground_truth(pair)  # stores the scoring points
        for name in ("before", "after"):
            session = json.loads((pair / name / "session.json").read_text())
            session["provenance"] = {"made_by": "x", "session": name, "sensor_profile": PROFILE, "seed": seed}
            write_json(pair / name / "session.json", {**session, "family": "sealed/gallery"})
            (pair / name / "descriptors-sealed.npz").write_bytes(b"sealed/gallery")
            os.utime(pair / name / "odometry.npz", (seed, seed))
        row = {"scenario": WORLD, "family": "sealed/gallery", "seed": seed, "variant": "ours", "status": "ok"}
        row |= {"preset": "ours", "pair_kind": "", "metrics_version": METRICS_VERSION}
        cell = {"key": "made", "order": [0, 0], "row": row}
        cell |= {table: [] for table in ("changes", "regions", "objects", "keyframes")}
        write_json(folder.cell(WORLD, seed, "ours"), cell)
    return folder


@pytest.fixture
def blind(run: RunFolder, tmp_path: Path) -> Path:
    assert export_blind(run, tmp_path / "blind") == len(SEEDS)
    return tmp_path / "blind"


def secrets_of(run: RunFolder) -> Iterator[bytes]:
    """Everything that a blind copy must not hold: names and numbers of the pairs, and rows of the truth's arrays."""
    for path in run.path.glob("pairs/*/*"):
        truth = read_pair_truth(path)
        for word in (truth.family, path.parent.name, path.name, str(run.path), PROFILE, "sealed", "gallery"):
            yield word.encode()
        for change in truth.changes:
            yield change.name.encode()
        for name in ("before", "after"):
            yield from (pose.tobytes() for pose in read_true_poses(path / name) if not np.array_equal(pose, np.eye(4)))
            for file in sorted((path / name / "truth").glob("0*.npz")):
                with np.load(file) as arrays:
                    yield from (arrays[kind].tobytes() for kind in ("instance", "change") if arrays[kind].any())
    if (run.path / "blind.json").exists():
        yield json.loads((run.path / "blind.json").read_text())["salt"].encode()


def test_no_byte_no_name_and_no_time_of_a_blind_copy_tells_what_it_is(run: RunFolder, blind: Path) -> None:
    everything = sorted(blind.rglob("*"))
    files = [path for path in everything if path.is_file()]
    assert {path.relative_to(blind).parts[1:] for path in files} == {
        (name, *rest)
        for name in ("before", "after")
        for rest in [("session.json",), ("odometry.npz",), *(("chunks", f"0000{k}.npz") for k in range(3))]
    }
    secrets = list(secrets_of(run))
    assert len(secrets) > 50
    for path in everything:
        content = str(path.relative_to(blind)).encode() + (path.read_bytes() if path.is_file() else b"")
        assert [secret for secret in secrets if secret in content] == [], path
        assert path.stat().st_mtime_ns == export.TIME_S * 10**9, path
        assert path.stat().st_nlink == 1 or path.is_dir()
        assert not path.is_symlink()
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                assert archive.comment == b""
                for member in archive.infolist():
                    assert (member.date_time, member.extra, member.comment) == ((1980, 1, 1, 0, 0, 0), b"", b"")
    (first, *_) = [json.loads(path.read_text()) for path in files if path.name == "session.json"]
    assert set(first) == {
        "format", "format_version", "n_scans", "chunk_scans", "units", "frames", "sensor", "provenance",
    }  # fmt: skip


def test_a_blind_copy_holds_the_same_scans(run: RunFolder, blind: Path) -> None:
    names = name_blindly(run)
    assert sorted(path.name for path in blind.iterdir()) == sorted(names.values())
    for pair, name in names.items():
        for session in ("before", "after"):
            original, copy = open_session(pair / session), open_session(blind / name / session)
            np.testing.assert_array_equal(copy.odom_T_sensor, original.odom_T_sensor)
            for one, other in zip(original.scans(), copy.scans(), strict=True):
                np.testing.assert_array_equal(one.points_sensor, other.points_sensor)
                np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)


def test_names_are_the_run_s_own_and_no_other_run_gives_them(run: RunFolder, blind: Path, tmp_path: Path) -> None:
    document = json.loads((run.path / "blind.json").read_text())
    told = {name: (each["scenario"], each["seed"]) for name, each in document["pairs"].items()}
    assert sorted(told.values()) == [(WORLD, seed) for seed in SEEDS]
    assert {run.pair(*pair) for pair in told.values()} == set(name_blindly(run))
    shutil.copytree(run.path, tmp_path / "again", ignore=shutil.ignore_patterns("blind.json"))
    again = RunFolder(tmp_path / "again")
    export_blind(again, tmp_path / "blind-again")
    assert not set(name_blindly(again).values()) & set(told)


def test_another_pair_under_the_same_scenario_and_seed_has_another_name(run: RunFolder, blind: Path) -> None:
    before = name_blindly(run)
    changed = run.pair(WORLD, SEEDS[0])
    document = json.loads((changed / "truth" / "changes.json").read_text())
    write_json(changed / "truth" / "changes.json", {**document, "scenario": {"other": 1}})
    after = name_blindly(run)
    assert [pair for pair in before if before[pair] != after[pair]] == [changed]


def test_an_interrupted_export_goes_on(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, real, calls = tmp_path / "blind", export.copy_session, []

    def interrupted(source: Path, target: Path, name: str) -> None:
        calls.append(target)
        if len(calls) == 4:
            raise KeyboardInterrupt
        real(source, target, name)

    monkeypatch.setattr(export, "copy_session", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_blind(run, out)
    (whole,) = out.iterdir()
    inode = (whole / "before" / "session.json").stat().st_ino
    (out / f".{sorted(name_blindly(run).values())[1]}.partial").mkdir()  # as a killed process leaves it
    assert export_blind(run, out) == 1
    assert sorted(path.name for path in out.iterdir()) == sorted(name_blindly(run).values())
    assert (whole / "before" / "session.json").stat().st_ino == inode
    assert len(calls) == 6
    assert export_blind(run, out) == 0


def test_a_folder_that_holds_something_else_is_refused(run: RunFolder, tmp_path: Path, command: Command) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    for flag in ("--blind", "--with-truth"):
        code, _, err = command("export", run.path, "--out", out, flag)
        assert code == 2 and err.count("\n") == 1
        assert f"{out}: holds notes.txt, which is no pair of this export" in err
    assert [path.name for path in out.iterdir()] == ["notes.txt"]
    code, _, err = command("export", run.path, "--out", run.path / "blind")
    assert code == 2 and "lies in the run folder, beside the truth" in err
    assert not (run.path / "blind").exists()
    (tmp_path / "file").write_text("mine")
    code, _, err = command("export", run.path, "--out", tmp_path / "file")
    assert code == 2 and "cannot write there" in err
    assert command("export", tmp_path / "none", "--out", tmp_path / "blind")[0] == 2
    pair = next(run.path.glob("pairs/*/*"))
    shutil.copytree(pair, pair.with_suffix(".bak"))
    code, _, err = command("export", run.path, "--out", tmp_path / "backup")
    assert code == 2 and f"holds {pair.parent.name}/{pair.name}.bak, whose name is no seed" in err
    shutil.rmtree(run.path / "pairs")
    code, _, err = command("export", run.path, "--out", tmp_path / "blind")
    assert code == 2 and "holds no simulated pairs" in err and not (tmp_path / "blind").exists()


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"salt": 3}', json.dumps({"salt": "0" * 64, "format_version": 9}), '{"salt": "../.."}']
)
def test_a_damaged_file_of_names_is_one_line(run: RunFolder, tmp_path: Path, command: Command, content: str) -> None:
    (run.path / "blind.json").write_text(content)
    code, _, err = command("export", run.path, "--out", tmp_path / "blind")
    assert code == 2 and err.count("\n") == 1 and str(run.path / "blind.json") in err
    (tmp_path / "mine").mkdir()
    assert command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")[0] == 2
    assert (run.path / "blind.json").read_text() == content


def test_pairs_with_truth_keep_their_names_and_all_their_files(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "open"
    assert export_with_truth(run, out) == len(SEEDS)
    for seed in SEEDS:
        pair = run.pair(WORLD, seed)
        copy = out / pair.parent.name / pair.name
        files = [path.relative_to(pair) for path in pair.rglob("*") if path.is_file()]
        assert len(files) > 20
        assert sorted(files) == sorted(path.relative_to(copy) for path in copy.rglob("*") if path.is_file())
        assert all((copy / file).read_bytes() == (pair / file).read_bytes() for file in files)
    assert not (run.path / "blind.json").exists()
    assert export_with_truth(run, out) == 0
    with pytest.raises(InputError, match="is no pair of this export"):
        export_blind(run, out)
    changed = run.pair(WORLD, SEEDS[0]) / "truth" / "changes.json"
    changed.write_text(changed.read_text().replace("thing 1", "thing 9"))
    with pytest.raises(InputError, match="an earlier simulation of this pair"):
        export_with_truth(run, out)


def test_the_command_exports_blind_unless_told_otherwise(run: RunFolder, tmp_path: Path, command: Command) -> None:
    code, out, err = command("export", run.path, "--out", tmp_path / "blind")
    told = "2 pairs of sessions written now, without truth; blind.json of the run says which is which"
    assert (code, out) == (0, f"{tmp_path / 'blind'}: {told}\n")
    assert WORLD not in out + err.replace(str(tmp_path), "")
    code, out, _ = command("export", run.path, "--out", tmp_path / "open", "--with-truth")
    assert (code, out) == (0, f"{tmp_path / 'open'}: 2 pairs of sessions written now, with truth\n")


def failed(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    document = {"format": "tunnelcd-answer", "format_version": 1, "status": "failed", "method": "theirs"}
    (folder / "answer.json").write_text(json.dumps(document))


def test_predictions_under_opaque_names_find_their_pairs(
    run: RunFolder, blind: Path, tmp_path: Path, command: Command
) -> None:
    names = name_blindly(run)
    first, second = (run.pair(WORLD, seed) for seed in SEEDS)
    failed(tmp_path / "mine" / names[first])
    failed(tmp_path / "mine" / second.parent.name / second.name)  # mixed with the names of the run
    assert command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")[0] == 0
    rows = pd.read_csv(run.path / "results.csv")
    assert rows.loc[rows["variant"] == "theirs", ["scenario", "seed"]].to_numpy().tolist() == [
        [WORLD, seed] for seed in SEEDS
    ]
    failed(tmp_path / "mine" / names[second])
    code, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")
    assert code == 2 and err.count("\n") == 1 and "two predictions for one pair" in err
    failed(tmp_path / "mine" / "0123456789abcdef")
    _, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")
    assert f"{tmp_path / 'mine' / '0123456789abcdef'}: the run has no such pair" in err


def test_a_missing_answer_is_named_as_the_blind_copy_is(
    run: RunFolder, blind: Path, tmp_path: Path, command: Command
) -> None:
    names = name_blindly(run)
    first, second = (run.pair(WORLD, seed) for seed in SEEDS)
    failed(tmp_path / "mine" / names[first])
    code, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")
    assert code == 2 and f"{tmp_path / 'mine' / names[second]}/answer.json" in err


def test_a_function_is_evaluated_on_blind_copies(run: RunFolder, tmp_path: Path) -> None:
    seen = []

    def predict(pair: Path, out: Path) -> None:
        secrets = list(secrets_of(run))
        for path in [pair, out, *pair.rglob("*")]:
            content = str(path).encode() + (path.read_bytes() if path.is_file() else b"")
            assert [secret for secret in secrets if secret in content] == [], path
        seen.append(len(open_session(pair / "after").odom_T_sensor))
        failed(out)

    rows = evaluate(predict, run.path, "theirs")
    assert seen == [14, 14]
    assert rows[["scenario", "seed", "status"]].to_numpy().tolist() == [[WORLD, seed, "failed"] for seed in SEEDS]


def test_a_function_sees_no_name_of_the_pairs_before(run: RunFolder) -> None:
    beside: list[str] = []

    def predict(pair: Path, out: Path) -> None:
        beside.extend(str(path.relative_to(pair.parent)) for path in pair.parent.rglob("*"))
        failed(out)

    evaluate(predict, run.path, "theirs")
    assert any(name.endswith("answer.json") for name in beside)  # the answer about the first pair is there
    assert [name for name in beside if "sealed" in name or any(str(seed) in name for seed in SEEDS)] == []


@pytest.mark.parametrize("is_reversed", [False, True])
def test_the_order_of_the_copies_is_that_of_their_opaque_names(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, is_reversed: bool
) -> None:
    def order_of(salt: str) -> list[int]:
        return sorted(SEEDS, key=lambda seed: export._opaque_name(salt, run.pair(WORLD, seed)))

    wanted = sorted(SEEDS, reverse=is_reversed)
    salt = next(salt for n in range(1000) if order_of(salt := f"{n:064x}") == wanted)
    write_json(run.path / "blind.json", {"format": "tunnelcd-blind", "format_version": 1, "salt": salt})
    copied: list[int] = []

    def copy_pair(original: Path, target: Path) -> None:
        copied.append(int(original.name))
        export.copy_pair(original, target)

    monkeypatch.setattr(predictions, "copy_pair", copy_pair)
    evaluate(lambda pair, out: failed(out), run.path, "theirs")
    assert copied == wanted


def test_a_name_that_is_taken_is_refused_before_the_function_is_called(run: RunFolder) -> None:
    with pytest.raises(InputError, match="has a variant of this name"):
        evaluate(lambda pair, out: pytest.fail("called"), run.path, "ours")


def test_a_function_that_fails_leaves_the_run_as_it_was(run: RunFolder) -> None:
    before = sorted(run.path.rglob("*"))
    with pytest.raises(ZeroDivisionError):
        evaluate(lambda pair, out: 1 // 0, run.path, "theirs")
    assert sorted(run.path.rglob("*")) == before
