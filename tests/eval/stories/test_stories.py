from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import cdpipe
from cdpipe.core.errors import InputError, MergeFailedError
from cdpipe.descriptors.sphere_network import make_untrained_sphere_network
from cdpipe.descriptors.weights_file import checkpoint_bytes
from cdpipe.io.session import read_session
from cdpipe.model.report import ChangedObject, ChangeReport, SurfaceField
from eval.core.output import only_writer
from eval.stories.comparisons import Method, list_sessions
from eval.stories.page import _displacement_at, displacement_table
from eval.stories.places import _measure, choose_places, follow_places
from eval.truth.ground_truth import load_ground_truth
from scenarios.schema import (
    Drift,
    Place,
    Platform,
    Prop,
    Roughness,
    Scenario,
    Section,
    Sensor,
    SessionPlan,
    SurfaceChange,
    SurfacePlace,
    Tunnel,
)
from sim.story import PairMaker, Story, simulate_story
from tests.eval.scoring.surface.surface_worlds import report_of, true_field

Command = Callable[..., tuple[int, str, str]]
LEVEL_M, N = 0.004, 3


def scenario() -> Scenario:
    where = SurfacePlace(between=("a", "b"), fraction=0.45)
    squeezed = SurfaceChange(name="squeezed", kind="convergence", place=where, depth_m=0.1, length_m=2.5)
    place = Place(between=("a", "b"), fraction=0.7, lateral=0.9)
    box = Prop(name="comes", kind="box", size_m=(0.6, 0.5, 0.5), place=place, change="added")
    return Scenario(
        family="test",
        tunnel=Tunnel(
            nodes={"a": (0, 0, 0), "b": (20, 0, 0)},
            drifts=(Drift(nodes=("a", "b")),),
            section=Section(width_m=4.0, height_m=3.2),
            roughness=(Roughness(amplitude_m=0.06, length_m=1.5),),
            resolution_m=0.2,
        ),
        props=(box,),
        surface=(squeezed,),
        sensor=Sensor(mode="512x10", range_noise=False),
        platform=Platform(scan_spacing_m=2.0),
        before=SessionPlan(route=("a", "b"), start_m=2.0, end_m=2.0),
        after=SessionPlan(route=("a", "b"), start_m=3.0, end_m=1.0),
    )


@pytest.fixture(scope="module", name="told")
def told_fixture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Story]:
    folder = tmp_path_factory.mktemp("story")
    return folder, simulate_story(scenario(), 1, N, folder)


class Oracle:
    """Answers with the truth of the pairs that the report made; keeps which sessions it was asked about."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.asked: list[str] = []
        self.stop: dict[str, BaseException] = {}

    def detect(self, before: Path, after: Path, *_: Any) -> ChangeReport:
        self.asked.append(after.name)
        assert before.name == "session-01"
        if after.name in self.stop:
            raise self.stop[after.name]
        truth = load_ground_truth(self.out / "pairs" / after.name.replace("session", "01"))
        objects = []
        for change, rows in zip(truth.pair.changes, truth.change_rows, strict=True):
            points = truth.sessions[change.session].scoring_points
            returns = np.column_stack([points.scans(rows), points.pixels(rows)]).astype(np.int32)
            places = points.points_odom[rows].astype(np.float64)
            objects.append(ChangedObject(change.session, change.kind, -1, returns, places, 1.0))
        field = true_field(truth, LEVEL_M)
        chainage_m, angle_deg = field.points_map[:, 0], np.zeros(len(field.points_map))
        field = replace(field, chainage_m=chainage_m, angle_deg=angle_deg)
        return replace(report_of(truth, field), objects=tuple(objects))


@pytest.fixture(scope="module", name="pairs")
def pairs_fixture(told: tuple[Path, Story], tmp_path_factory: pytest.TempPathFactory) -> Path:
    pairs, maker = tmp_path_factory.mktemp("pairs"), PairMaker(told[0])
    for number in range(2, N + 1):
        (pairs / f"1-{number}").mkdir()
        maker.make(1, number, pairs / f"1-{number}")
    return pairs


@pytest.fixture(name="oracle")
def oracle_fixture(tmp_path: Path, pairs: Path, monkeypatch: pytest.MonkeyPatch) -> Oracle:
    def copy(_: PairMaker, before: int, after: int, out: Path, *__: Any) -> None:
        shutil.copytree(pairs / f"{before}-{after}", out, dirs_exist_ok=True)

    oracle = Oracle(tmp_path / "report")
    monkeypatch.setattr(cdpipe, "detect", oracle.detect)
    monkeypatch.setattr(PairMaker, "make", copy)  # they were made once
    return oracle


def test_the_truth_as_answer_follows_the_creep_and_the_props(
    told: tuple[Path, Story], oracle: Oracle, command: Command
) -> None:
    folder, story = told
    code, _, err = command("story", folder, "--out", oracle.out, "--at", "3.0,-1.9,0.4", "-q")
    assert code == 0, err
    moved = pd.read_csv(oracle.out / "displacement.csv")
    region = moved[moved["chosen_by"] == "region"]
    assert region["place"].nunique() == 1  # one region of one change
    np.testing.assert_allclose(region["displacement_m"], region["true_m"], atol=0.004)
    shares = [state.shares["squeezed"] for state in story.sessions[1:]]
    np.testing.assert_allclose(region["true_m"] / region["true_m"].iloc[-1], shares, atol=0.05)
    assert region["true_m"].iloc[-1] > 0.08
    assert region["is_beyond_level"].all() and (region["level_m"] == LEVEL_M).all()
    given = moved[moved["chosen_by"] == "given"]
    assert given["n_points"].gt(0).all() and not given["is_beyond_level"].any() and (given["true_m"] == 0).all()
    props = pd.read_csv(oracle.out / "props.csv").set_index("session")
    assert props.loc[N, ["prop", "true_kind", "answered_kind", "verdict"]].tolist() == [
        "comes",
        "added",
        "added",
        "right",
    ]
    page = (oracle.out / "index.html").read_text()
    assert "squeezed (convergence)" in page and "comes (box)" in page and "http" not in page.split("<script>")[0]


def test_an_interrupted_report_goes_on_where_it_stopped(
    told: tuple[Path, Story], oracle: Oracle, command: Command
) -> None:
    oracle.stop = {"session-03": KeyboardInterrupt()}
    code, _, err = command("story", told[0], "--out", oracle.out, "-q")
    assert code == 130 and "finished comparisons are kept" in err
    assert [path.name for path in (oracle.out / "answers").iterdir()] == ["01-02"]
    oracle.stop = {}
    assert command("story", told[0], "--out", oracle.out, "-q")[0] == 0
    assert oracle.asked == ["session-02", "session-03", "session-03"]


def test_a_second_report_in_the_folder_is_refused(told: tuple[Path, Story], oracle: Oracle, command: Command) -> None:
    oracle.out.mkdir()
    with only_writer(oracle.out, "tunnelcd story"):
        code, _, err = command("story", told[0], "--out", oracle.out, "-q")
    assert code == 2 and "another `tunnelcd story` writes there" in err
    assert list(oracle.out.iterdir()) == []


def test_a_refused_merge_is_a_gap_that_the_page_names(
    told: tuple[Path, Story], oracle: Oracle, command: Command
) -> None:
    oracle.stop = {"session-02": MergeFailedError("too little overlap", {"overlap": 0.1})}
    assert command("story", told[0], "--out", oracle.out, "-q")[0] == 0
    moved = pd.read_csv(oracle.out / "displacement.csv").set_index("session")
    assert np.isnan(moved.loc[2, "displacement_m"]) and moved.loc[2, "true_m"] > 0.01
    assert "Session 2: too little overlap" in (oracle.out / "index.html").read_text()
    assert "<td>session 2</td><td>\u2013</td>" in "".join((oracle.out / "index.html").read_text().split("\n"))


def test_without_a_merge_nothing_is_said_of_rock(told: tuple[Path, Story], oracle: Oracle, command: Command) -> None:
    refusal = MergeFailedError("too little overlap", {"overlap": 0.1})
    oracle.stop = {f"session-0{number}": refusal for number in range(2, N + 1)}
    code, out, _ = command("story", told[0], "--out", oracle.out)
    assert code == 0 and "rock was not measured in any session" in out
    page = (oracle.out / "index.html").read_text()
    assert "Rock was not measured" in page and "No region of rock moved" not in page


def test_what_is_beyond_its_level_is_bold() -> None:
    place = {"place": "A", "x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "displacement_m": 0.01, "true_m": 0.01}
    rows = [{**place, "session": 2, "level_m": 0.004, "is_beyond_level": True},
            {**place, "session": 3, "level_m": 0.04, "is_beyond_level": False}]  # fmt: skip
    for more in ([], [{**place, "session": 4, "level_m": np.nan, "is_beyond_level": None}]):
        ((_, cells),) = displacement_table(pd.DataFrame([*rows, *more]), has_truth=False).rows
        assert [cell.is_best for cell in cells[2:4]] == [True, False]


def test_a_level_that_a_point_lacks_is_that_of_the_others() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    for levels_m, level_m, is_beyond in (([0.002, 0.004, np.nan], 0.003, True), ([np.nan] * 3, np.nan, None)):
        field = SurfaceField(points, np.eye(3), np.full(3, 0.01), np.array(levels_m), np.full(3, -1, np.int32))
        found = _measure(field, np.zeros(3))
        np.testing.assert_allclose([found["displacement_m"], found["level_m"]], [0.01, level_m])
        assert found["is_beyond_level"] is is_beyond


def test_where_nothing_was_measured_nothing_is_beyond_a_level() -> None:
    nan = np.full(1, np.nan)
    field = SurfaceField(np.zeros((1, 3)), np.eye(3)[:1], nan, nan, np.full(1, -1, np.int32))
    for surface in (None, field):
        found = _measure(surface, np.zeros(3))
        assert found["n_points"] == 0 and found["is_beyond_level"] is None


def test_an_unmeasured_place_is_grey_beside_measured_ones() -> None:
    points, nan = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.4, 0.0, 0.0]]), np.full(3, np.nan)
    field = SurfaceField(points, np.eye(3), np.array([0.01, np.nan, 0.03]), nan, np.full(3, -1, np.int32))
    asked = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.4, 0, 0], [0.69, 0, 0], [0.71, 0, 0]])
    np.testing.assert_array_equal(_displacement_at(asked, field), [0.01, np.nan, 0.03, 0.03, np.nan])
    none = SurfaceField(np.zeros((0, 3)), np.zeros((0, 3)), nan[:0], nan[:0], np.zeros(0, np.int32))
    assert np.isnan(_displacement_at(asked, none)).all()


def test_without_truth_the_sessions_alone_are_compared(
    told: tuple[Path, Story], oracle: Oracle, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    truths = Oracle(oracle.out.with_name("with"))
    monkeypatch.setattr(cdpipe, "detect", truths.detect)
    assert command("story", told[0], "--out", truths.out, "-q")[0] == 0
    monkeypatch.setattr(oracle, "out", truths.out)
    monkeypatch.setattr(cdpipe, "detect", oracle.detect)
    out = truths.out.with_name("without")
    assert command("story", told[0], "--out", out, "--without-truth", "-q")[0] == 0
    assert not (out / "pairs").exists()
    moved = pd.read_csv(out / "displacement.csv")
    assert moved["true_m"].isna().all() and moved["displacement_m"].notna().all()
    assert pd.read_csv(out / "props.csv").empty


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--at", "1,2"), "--at 1,2: expected three numbers in metres"),
        (("--at", "1,2,nan"), "--at 1,2,nan: expected three numbers"),
        (("--at", "300,0,0"), r"--at 300,0,0: no rock was measured within 0.3 m of it"),
    ],
)
def test_a_bad_place_is_one_line(
    told: tuple[Path, Story], oracle: Oracle, command: Command, words: tuple[str, str], why: str
) -> None:
    code, _, err = command("story", told[0], "--out", oracle.out, *words, "-q")
    assert code == 2 and why in err and err.count("\n") == 1
    assert not (oracle.out / "index.html").exists()


def test_a_folder_of_another_story_or_method_is_refused(
    told: tuple[Path, Story], oracle: Oracle, command: Command, tmp_path: Path
) -> None:
    oracle.out.mkdir()
    (oracle.out / "mine.txt").write_text("kept")
    code, _, err = command("story", told[0], "--out", oracle.out)
    assert code == 2 and "is not empty, and no report of a story" in err
    (oracle.out / "mine.txt").unlink()
    oracle.stop = {"session-02": KeyboardInterrupt()}
    assert command("story", told[0], "--out", oracle.out, "-q")[0] == 130
    code, _, err = command("story", told[0], "--out", oracle.out, "--set", "surface.radius_m=0.7")
    assert code == 2 and "is the report of another method, settings or weights" in err
    code, _, err = command("story", tmp_path, "--out", tmp_path / "other")
    assert code == 2 and "expected session-01 and later sessions" in err


def test_the_command_line_makes_stories_and_pairs(command: Command, tmp_path: Path, told: tuple[Path, Story]) -> None:
    code, _, err = command("simulate", "smoke/one_box", "--sessions", "13", "--out", tmp_path / "x")
    assert code == 2 and "--sessions" in err
    code, told_of, _ = command("pair", told[0], 2, 1, "--out", tmp_path / "pair")
    assert code == 0 and "1 of rock" in told_of
    assert read_session(tmp_path / "pair" / "before").provenance["session"] == "session-02"
    code, _, err = command("pair", told[0], 2, 2, "--out", tmp_path / "other")
    assert code == 2 and not (tmp_path / "other").exists()


def test_places_of_one_region_are_chosen_once() -> None:
    with pytest.raises(InputError, match="unknown"):
        Method("no-such-preset", "narrow", ()).config  # noqa: B018
    assert choose_places([], [np.array([1.0, 2.0, 3.0])])[0].name == "P1"
    assert follow_places([], []).empty


def test_answers_of_other_weights_are_never_mixed(
    told: tuple[Path, Story], oracle: Oracle, command: Command, tmp_path: Path
) -> None:
    weights = tmp_path / "w.safetensors"
    argv = ("story", told[0], "--out", oracle.out, "--set", f"sphere.weights={weights}", "-q")
    weights.write_bytes(checkpoint_bytes(make_untrained_sphere_network(1)))
    oracle.stop = {"session-03": KeyboardInterrupt()}
    assert command(*argv)[0] == 130
    weights.write_bytes(checkpoint_bytes(make_untrained_sphere_network(2)))
    code, _, err = command(*argv)
    assert code == 2 and "is the report of another method, settings or weights" in err


def test_a_story_with_equal_poses_and_other_scans_or_truth_is_another_one(
    told: tuple[Path, Story], oracle: Oracle, command: Command, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(told[0], other)
    argv = ("story", other, "--out", oracle.out, "-q")
    oracle.stop = {"session-02": KeyboardInterrupt()}
    assert command(*argv)[0] == 130
    text = (other / "story.json").read_text()
    scans = told[1].digests["session-02"]["chunks/00000.npz"]
    assert scans in text and '"seed": 1' in text
    for changed in (text.replace(scans, "0" * 64), text.replace('"seed": 1', '"seed": 2')):
        (other / "story.json").write_text(changed)
        code, _, err = command(*argv)
        assert code == 2 and "is the report of another story" in err
    (other / "story.json").write_text(text)
    assert command(*argv)[0] == 130


def test_recorded_sessions_with_other_scans_are_another_story(
    told: tuple[Path, Story], oracle: Oracle, command: Command, tmp_path: Path
) -> None:
    recorded = tmp_path / "recorded"
    shutil.copytree(told[0], recorded)
    (recorded / "story.json").unlink()
    argv = ("story", recorded, "--out", oracle.out, "-q")
    oracle.stop = {"session-02": KeyboardInterrupt()}
    assert command(*argv)[0] == 130
    scans = recorded / "session-03" / "chunks" / "00000.npz"
    scans.write_bytes(scans.read_bytes() + b"changed")
    code, _, err = command(*argv)
    assert code == 2 and "is the report of another story" in err


def test_a_story_that_lost_a_session_is_refused(told: tuple[Path, Story], tmp_path: Path) -> None:
    lost = tmp_path / "lost"
    shutil.copytree(told[0], lost)
    shutil.rmtree(lost / "session-02")
    with pytest.raises(InputError, match=r"session-02: missing, or damaged: simulate the story again"):
        list_sessions(lost)
