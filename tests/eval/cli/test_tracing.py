from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
import trimesh
import yaml

from eval.cli.main import main

SMALL = ("--world", "sensor.mode=512x10", "--world", "platform.scan_spacing_m=4")


def run(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str, str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main([str(each) for each in argv])
    out, err = capsys.readouterr()
    return int(caught.value.code or 0), out, err


def save_drift(path: Path, scale: float = 1.0) -> Path:
    """Write a closed drift along x, 4 m wide and 3 m high, in 1 / scale metres."""
    solid = trimesh.creation.box(extents=(30.0, 4.0, 3.0))
    for _ in range(5):  # edges of 1 m; subdivide_to_size leaves cracks in old versions
        solid = solid.subdivide()
    solid.apply_translation((15.0, 0.0, 1.5))
    solid.invert()
    solid.apply_scale(scale)
    path.parent.mkdir(exist_ok=True)
    solid.export(path)
    return path


def test_a_mesh_becomes_a_scenario_that_is_checked_and_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = save_drift(tmp_path / "meshes" / "mine.stl")
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, "trace", mesh, "--out", "own/mine.yaml")
    assert (code, out.count("\n")) == (0, 1)
    assert "m of drift, 4.0 to 4.0 m wide" in out and "own/mine.png" in out
    assert Path("own/mine.png").read_bytes()[:4] == b"\x89PNG"
    tree = yaml.safe_load(Path("own/mine.yaml").read_text())
    assert tree["tunnel"]["mesh"] == {"path": "../meshes/mine.stl", "units": "m", "up": "z"}
    assert run(capsys, "check", "own/mine.yaml")[0] == 0
    code, _, err = run(capsys, "simulate", "own/mine.yaml", "--seed", 1, "--out", "pair", "--quiet", *SMALL)
    assert (code, err) == (0, "")
    assert sorted(path.name for path in Path("pair").iterdir()) == ["after", "before", "truth"]


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = save_drift(tmp_path / "mine.stl", 1000.0)
    dust = save_drift(tmp_path / "dust.stl", 1e-9)
    kept = tmp_path / "kept.yaml"
    kept.write_text("")
    out = tmp_path / "new" / "mine.yaml"
    for argv, told in (
        ((mesh, "--out", out), "give --units mm (3 m)"),
        ((mesh, "--out", kept), "exists: name a new file"),
        ((mesh, "--out", tmp_path / "mine.txt"), "a scenario is a .yaml file"),
        ((mesh, "--out", out, "--picture", tmp_path / "a.jpg"), "name a new .png file"),
        ((tmp_path, "--out", out), "is a folder"),
        ((mesh, "--out", "."), "a scenario is a .yaml file"),
        ((mesh, "--out", ""), "a scenario is a .yaml file"),
        ((mesh, "--out", tmp_path / f"{'x' * 300}.yaml"), "File name too long"),
        ((tmp_path / "\udcff.stl", "--out", out), "is not UTF-8"),
        ((tmp_path / "none.stl", "--out", out), f"error: {tmp_path / 'none.stl'}: no such file\n"),
        ((dust, "--out", out), "are --units right?"),
    ):
        code, printed, err = run(capsys, "trace", *argv, "--quiet")
        assert (code, printed) == (2, "")
        assert told in err and err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dust.stl", "kept.yaml", "mine.stl"]


def test_units_that_are_named_are_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = save_drift(tmp_path / "mine.stl", 1000.0)
    out = tmp_path / "mine.yaml"
    picture = tmp_path / "p.png"
    assert run(capsys, "trace", mesh, "--units", "mm", "--out", out, "--picture", picture, "-q") == (0, "", "")
    assert picture.is_file()
    nodes = yaml.safe_load(out.read_text())["tunnel"]["nodes"]
    assert 25.0 < max(x for x, _, _ in nodes.values()) < 30.0


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc, where nobody can make a file")
def test_a_picture_that_cannot_be_written_is_told_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = save_drift(tmp_path / "mine.stl")
    monkeypatch.setattr("sim.trace.trace_mesh", lambda *_, **__: pytest.fail("traced"))
    code, out, err = run(capsys, "trace", mesh, "--out", tmp_path / "a" / "b" / "t.yaml", "--picture", "/proc/x.png")
    assert (code, out, err.count("\n")) == (2, "", 1) and err.startswith("error: /proc: cannot write there")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.stl"]


@pytest.mark.parametrize("full", ["t.yaml", "t.png"])
def test_a_full_disk_is_told_with_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, full: str
) -> None:
    def fill(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    mesh = save_drift(tmp_path / "mine.stl")
    if full == "t.png":
        monkeypatch.setattr("sim.trace.save_picture", fill)
    else:
        monkeypatch.setattr(Path, "write_text", fill)
    code, _, err = run(capsys, "trace", mesh, "--out", tmp_path / "t.yaml", "--quiet")
    assert code == 2 and err.startswith(f"error: {tmp_path / full}: cannot write there (No space left on device)")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.stl"]
