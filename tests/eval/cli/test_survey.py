from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from eval.cli.main import main
from sim.studies import survey as surveys
from sim.studies.survey import Failure, Survey, WorldFigures

WORLD = WorldFigures(
    family="narrow", seed=5, before_path_m=100.0, after_path_m=90.0, width_m=4.0, height_m=3.0, n_added=1, n_removed=0,
    n_moved=0, n_reshaped=0, hull_m3=(0.5,), distractors_per_100m=8.0, far_share=0.8, repose_deg=(), roughness_m=0.05,
    interpenetration_m=0.002, n_triangles=1000, build_s=2.0,
)  # fmt: skip


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main(["survey", *argv])
    out, err = capsys.readouterr()
    return int(caught.value.code or 0), out, err


@pytest.fixture(autouse=True)
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """No world is built: one of three seeds fails; returns what was asked for."""
    calls: list[Any] = []

    def survey(family: str, seeds: Sequence[int], workers: int, on_progress: object) -> Survey:
        calls.append((family, tuple(seeds), workers))
        return Survey(family, (WORLD, WORLD), (Failure(family, 7, "no room"),))

    monkeypatch.setattr(surveys, "survey", survey)
    return calls


def test_failed_seeds_are_told_and_the_exit_code_is_0(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[Any]
) -> None:
    file = tmp_path / "survey.csv"
    code, out, _ = run(capsys, "narrow", "wide", "--seeds", "5:8", "--workers", "2", "--out", str(file))
    assert code == 0
    assert asked == [("narrow", (5, 6, 7), 2), ("wide", (5, 6, 7), 2)]
    assert "failed: narrow, seed 7: no room" in out and "failed: wide, seed 7: no room" in out
    assert f"4 worlds built, 2 failed; one row each in {file}" in out
    assert "far keyframes" in out and "2 of 3" in out
    assert len(file.read_text().splitlines()) == 1 + 6


def test_a_file_that_is_no_survey_is_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[Any]
) -> None:
    file = tmp_path / "narrow.yaml"
    file.write_text("family: narrow\n")
    code, _, err = run(capsys, "narrow", "--out", str(file))
    assert (code, asked) == (2, [])
    assert err == f"error: {file}: exists, and is no table of `tunnelcd survey`: name a new file, or remove it\n"
    assert file.read_text() == "family: narrow\n"
    for _ in range(2):  # its own table is
        assert run(capsys, "narrow", "--quiet", "--out", str(tmp_path / "s.csv"))[0] == 0


def test_the_markdown_can_be_pasted(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "narrow", "--markdown", "--quiet")
    table = [line for line in out.splitlines() if line.startswith("|")]
    assert (code, len(table)) == (0, 3)
    assert table[2].startswith("| `narrow` | 2 of 3 |")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--seeds", "8:5"], "--seeds 8:5: expected"), (["--out", "{file}/below/x.csv"], "cannot write there")],
)
def test_mistaken_options_build_nothing(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[Any]
) -> None:
    file = tmp_path / "file"
    file.touch()
    code, _, err = run(capsys, "narrow", *(word.format(file=file) for word in arguments))
    assert (code, words in err, asked) == (2, True, [])
