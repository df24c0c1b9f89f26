from __future__ import annotations

import csv
import errno
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError, ScenarioError
from sim.studies import survey as surveys
from sim.studies.survey import Failure, Survey, WorldFigures, markdown, summary, survey, survey_seed, write_csv

# A straight smooth drift 60 m long, 4 m wide, 3 m high, driven from 2 m to 58 m before and from 5 m to 59 m after.
SCENARIO = """\
description: by hand
score_radius_m: 4.5
tunnel:
  nodes: {a: [0, 0, 0], b: [60, 0, 0]}
  drifts: [{nodes: [a, b]}]
  section: {shape: rectangle, width_m: 4, height_m: 3}
  resolution_m: 0.25
props:
  - name: box
    kind: box
    size_m: [0.8, 0.6, 0.5]
    place: {between: [a, b], fraction: 0.5, lateral: 0.8}
    change: added
  - name: drum
    kind: box
    size_m: [0.5, 0.5, 1.0]
    place: {between: [a, b], fraction: 0.52, lateral: -0.8}
    to: {between: [a, b], fraction: 0.55, lateral: -0.8}
    change: moved
  - {name: near, kind: box, size_m: [0.5, 0.5, 0.4], place: {between: [a, b], fraction: 0.2, lateral: 0.8}}
  - {name: end, kind: box, size_m: [0.5, 0.5, 0.4], place: {between: [a, b], fraction: 0.8, lateral: 0.8}}
platform: {scan_spacing_m: 1.0, tilt_deg: 0.0}
before: {route: [a, b], lateral: 0.0, start_m: 2, end_m: 2}
after: {route: [a, b], lateral: 0.0, start_m: 5, end_m: 1}
"""


@pytest.fixture(scope="module")
def family(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("survey") / "by_hand.yaml"
    path.write_text(SCENARIO)
    return str(path)


@pytest.fixture(scope="module")
def world(family: str) -> WorldFigures:
    return survey_seed(family, 3)


def test_the_figures_of_a_world_by_hand(world: WorldFigures) -> None:
    assert world.before_path_m == pytest.approx(56.0, abs=0.3)
    assert world.after_path_m == pytest.approx(54.0, abs=0.3)
    assert world.width_m == pytest.approx(4.0, abs=0.1)
    assert world.height_m == pytest.approx(3.0, abs=0.1)
    assert (world.n_added, world.n_removed, world.n_moved, world.n_reshaped, world.n_changes) == (1, 0, 1, 0, 2)
    np.testing.assert_allclose(sorted(world.hull_m3), [0.24, 0.25], rtol=1e-3)
    # two props over 56 keyframes of one metre
    assert world.distractors_per_100m == pytest.approx(2 / 0.56, rel=0.02)
    # changes at x = 30, 31.2 and 33, about 1.4 m aside: keyframes from 21.1 to 41.9 m are within 9 m; of those at 2, 3,
    # … 57 m these are the 20 from 22 to 41
    assert world.far_share == pytest.approx(1 - 20 / 56, abs=0.04)
    assert world.repose_deg == ()
    assert world.roughness_m < 0.01
    assert world.interpenetration_m < 0.01
    assert world.n_triangles > 1000
    assert 0 < world.build_s < 60


def test_the_figures_do_not_depend_on_the_number_of_processes(family: str, world: WorldFigures) -> None:
    told: list[tuple[str, int, int]] = []
    found = survey(family, [3, 4], workers=2, on_progress=lambda *words: told.append(words))
    assert [one.seed for one in found.worlds] == [3, 4]
    assert found.failures == ()
    for name in ("far_share", "hull_m3", "roughness_m", "n_triangles", "before_path_m"):
        assert getattr(found.worlds[0], name) == getattr(world, name)
    assert [words[1:] for words in told] == [(0, 2), (1, 2), (2, 2)]


def test_a_seed_that_fails_is_counted_and_stops_nothing(
    family: str, world: WorldFigures, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons = {1: ScenarioError("no room\n for it"), 2: ZeroDivisionError("a bug")}

    def one(_: str, seed: int) -> WorldFigures:
        if seed in reasons:
            raise reasons[seed]
        return world

    monkeypatch.setattr(surveys, "survey_seed", one)
    found = survey(family, [1, 2, 3])
    assert found.worlds == (world,)
    assert found.failures == (
        Failure(family, 1, "no room for it"),
        Failure(family, 2, "ZeroDivisionError: a bug"),
    )
    assert summary(found)["worlds"] == "1 of 3"


def test_mistakes_in_the_file_are_no_failures_of_seeds(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(SCENARIO.replace("score_radius_m", "score_radius"))
    with pytest.raises(ScenarioError, match="did you mean"):
        survey(str(path), [0, 1])


def figures(seed: int, **override: object) -> WorldFigures:
    values: dict[str, object] = {
        "family": "f", "seed": seed, "before_path_m": 100.0, "after_path_m": 90.0, "width_m": 4.0, "height_m": 3.0,
        "n_added": 1, "n_removed": 0, "n_moved": 0, "n_reshaped": 0, "hull_m3": (0.5,), "distractors_per_100m": 8.0,
        "far_share": 0.8, "repose_deg": (), "roughness_m": 0.05, "interpenetration_m": 0.002, "n_triangles": 1000,
        "build_s": 2.0,
    }  # fmt: skip
    return WorldFigures(**(values | override))  # type: ignore[arg-type] - keys and values as above


def test_the_row_of_a_family_by_hand() -> None:
    worlds = (
        figures(0, hull_m3=(0.5, 4.0), n_moved=1, repose_deg=(36.0,)),
        figures(1, hull_m3=(1.0,), far_share=0.6, before_path_m=120.0, interpenetration_m=0.004),
        figures(2, hull_m3=(), n_added=0, far_share=1.0, before_path_m=200.0, roughness_m=float("nan")),
    )
    row = summary(Survey("f", worlds, (Failure("f", 3, "x"),)))
    assert row["worlds"] == "3 of 4"
    assert row["path before, m"] == "100 - 120 - 200"
    assert row["changes"] == "0 - 1 - 2"
    assert row["added, removed, moved, reshaped"] == "2, 0, 1, 0"
    assert row["hull, m3"] == "0.50 - 1.00 - 4.00"
    assert row["far keyframes"] == "80 %, least 60 %"
    assert row["repose, deg"] == "36.0 - 36.0 - 36.0"
    assert row["roughness, m"] == "0.050 - 0.050 - 0.050"
    assert row["deepest in rock, mm"] == "4.0"
    lines = markdown([Survey("f", worlds, ())]).splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("| family | worlds | path before, m |")
    assert lines[2].startswith("| `f` | 3 of 3 | 100 - 120 - 200 |")
    assert len({line.count("|") for line in lines}) == 1


def test_a_family_of_failures_has_a_row_without_figures() -> None:
    row = summary(Survey("f", (), (Failure("f", 3, "x"),)))
    assert row.pop("worlds") == "0 of 1"
    assert row.pop("family") == "f"
    assert row.pop("added, removed, moved, reshaped") == "0, 0, 0, 0"
    assert set(row.values()) == {"-"}


def test_the_csv_has_one_row_per_seed_and_the_reasons(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    write_csv(
        path, [Survey("f", (figures(0, hull_m3=(0.5, 1.0, 4.0)), figures(2, hull_m3=())), (Failure("f", 1, "x, y"),))]
    )
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["family"], row["seed"], row["failure"]) for row in rows] == [
        ("f", "0", ""), ("f", "2", ""), ("f", "1", "x, y"),
    ]  # fmt: skip
    assert [rows[0][f"hull_m3_{name}"] for name in ("min", "median", "max")] == ["0.5", "1.0", "4.0"]
    assert (rows[1]["hull_m3_min"], rows[2]["before_path_m"]) == ("", "")
    with pytest.raises(InputError, match="cannot write there"):
        write_csv(tmp_path / "absent" / "survey.csv", [])


def test_a_full_disk_leaves_the_earlier_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "survey.csv"
    path.write_bytes(b"earlier")
    monkeypatch.setattr(csv.DictWriter, "writerows", fail)
    with pytest.raises(InputError, match=r"survey\.csv: cannot write there: No space left on device"):
        write_csv(path, [Survey("f", (), (Failure("f", 1, "x"),))])
    assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [("survey.csv", b"earlier")]
