"""The 3-D view of a pair: both maps in one frame, boxes around the true changes, and one offline file."""

import importlib.util
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.io.answer import write_answer, write_failure
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from eval.report.answer.shapes import box_path, roof_mask, sphere_path
from eval.report.site.case_view import case_view, write_case_view
from eval.report.site.views import write_views
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder
from eval.truth.ground_truth import load_ground_truth

N_SCANS = 14
needs_viser = pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="the extra view is not installed")


def report(before_T_after: np.ndarray, radius_m: float = 3.0) -> ChangeReport:
    keyframes = np.arange(N_SCANS, dtype=np.int64)
    regions = ChangeRegions(
        centres_map=np.array([[1.0, 2.0, 0.5], [9.0, 2.0, 0.5]]), radius_m=radius_m, scores=np.array([0.9, 0.2]),
        pairs=np.array([[2, 2], [5, 5]]), is_reported=np.array([True, False]), keyframe_scores=np.zeros(N_SCANS),
    )  # fmt: skip
    item = ChangedObject("after", "added", 0, np.zeros((1, 2), np.int32), np.array([[1.0, 2.0, 3.0]]), 1.0)
    return ChangeReport(before_T_after, {}, regions, (item,), {}, {}, (keyframes, keyframes), {})


def test_a_box_in_one_stroke_has_all_twelve_edges_and_no_diagonal() -> None:
    low, high = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0])
    path = box_path(low, high)
    steps = np.diff(path, axis=0)
    assert ((steps != 0).sum(axis=1) == 1).all()
    edges = {tuple(sorted((tuple(a), tuple(b)))) for a, b in itertools.pairwise(path)}
    assert len(edges) == 12
    np.testing.assert_array_equal([path.min(axis=0), path.max(axis=0)], [low, high])


def test_circles_lie_on_their_sphere_and_reach_all_six_poles() -> None:
    centre = np.array([5.0, -1.0, 2.0])
    path = sphere_path(centre, 4.5)
    np.testing.assert_allclose(np.linalg.norm(path - centre, axis=1), 4.5, atol=1e-12)
    for axis in range(3):
        assert [path[:, axis].min(), path[:, axis].max()] == pytest.approx([centre[axis] - 4.5, centre[axis] + 4.5])
    # one stroke: no step is longer than the circles' own
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 1.0


def test_roof_is_what_is_high_over_the_nearest_place_of_the_path() -> None:
    path = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 5.0]])
    points = np.array([[1.0, 1.0, 1.1], [1.0, 1.0, 1.3], [9.0, 0.0, 6.1], [9.0, 0.0, 6.3]])
    assert roof_mask(points, path).tolist() == [False, True, False, True]
    assert roof_mask(np.zeros((0, 3)), path).tolist() == []


def test_both_maps_and_all_changes_are_in_one_frame(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    truth = load_ground_truth(tiny_pair)
    before = truth.before.scoring_points.points_odom[::5].astype(np.float64)
    # the same world points as the after robot has them
    after = (before - tiny_merge[:3, 3]) @ tiny_merge[:3, :3]
    rows = {"changes": [{"id": 1, "is_found": True}, {"id": 2, "is_found": False}]}
    view = case_view("here", (before, after), truth, report(tiny_merge), rows)
    clouds = {cloud.name: cloud for cloud in view.clouds}
    for part in ("floor and walls", "roof"):
        ours, theirs = (clouds[f"{name} map/{part}"].points for name in ("before", "after"))
        assert ours.dtype == np.float32
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert not clouds["before map/roof"].is_shown
    assert clouds["answer/added/object 0"].points.tolist() == [[1.0, 2.0, 3.0]]
    boxes = [line.name for line in view.lines if line.name.startswith("truth/")]
    assert boxes == ["truth/found/1 thing 1", "truth/missed/2 thing 2", "truth/missed/3 thing 3"]
    # thing 2 stood before, thing 3 is where it went: both boxes hold their own true cells, in the map frame
    for index, line in enumerate(line for line in view.lines if line.name.startswith("truth/")):
        cells = truth.points_odom(index)
        if truth.pair.changes[index].session == "after":
            cells = cells @ tiny_merge[:3, :3].T + tiny_merge[:3, 3]
        np.testing.assert_allclose(line.points.min(axis=0), cells.min(axis=0) - 0.15, atol=1e-9)
    # one region is reported, the other is not
    assert [line.name for line in view.lines if line.name.startswith("regions/")] == ["regions/not scored/region 0"]
    for outcome, word in (("true", "true"), ("false", "false"), ("duplicate", "true")):
        scored = {**rows, "regions": [{"region": 0, "outcome": outcome}]}
        view = case_view("here", (before, after), truth, report(tiny_merge), scored)
        assert [line.name for line in view.lines if line.name.startswith("regions/")] == [f"regions/{word}/region 0"]
    unscored = case_view("here", (before, after), truth, report(tiny_merge), {})
    assert {line.name.split("/")[1] for line in unscored.lines if line.name.startswith("truth/")} == {"not scored"}
    assert "missed" in next(label.text for label in view.labels if np.array_equal(label.position, view.target))


@pytest.fixture
def run(tiny_pair: Path, tiny_merge: np.ndarray, tmp_path: Path) -> RunData:
    folder = RunFolder(tmp_path / "run")
    folder.pair("tiny", 7).parent.mkdir(parents=True)
    tiny_pair.rename(folder.pair("tiny", 7))
    write_answer(folder.answer("tiny", 7, "tunnelcd"), "tunnelcd", report(tiny_merge))
    write_failure(folder.answer("tiny", 7, "paper"), "paper", "merge_refused", "no way", {}, {})
    points = np.random.default_rng(0).uniform(-3, 3, (500, 3)).astype(np.float32)
    folder.maps("tiny", 7).parent.mkdir(parents=True)
    np.savez(folder.maps("tiny", 7), before_points=points, after_points=points)
    rows = [
        {"scenario": "tiny", "seed": seed, "variant": name, "status": "ok", "is_unchanged_pair": False}
        for seed in (7, 8, 9) for name in ("tunnelcd", "paper")
    ]  # fmt: skip
    return RunData(folder, tuple(rows), (), (), {}, ())


@needs_viser
def test_a_view_is_one_file_that_asks_no_network(run: RunData) -> None:
    file = write_case_view(run.folder, ("tiny", 7), "tunnelcd", {})
    text = file.read_text()
    assert file == run.folder.path / "views" / "tiny" / "7.html"
    assert "<title>tiny, seed 7</title>" in text
    assert "box: true change, missed" in text
    assert re.findall(r"<(?:script|link|img)[^>]*\s(?:src|href)=\"(?!data:)[^\"]*\"", text) == []


@needs_viser
def test_only_pairs_that_are_there_get_a_view(run: RunData) -> None:
    found = write_views(run, "tunnelcd", [("tiny", 8)])
    assert dict(found.links) == {("tiny", 7): "views/tiny/7.html"}
    assert (found.of("tiny", 7), found.of("tiny", 8)) == ("views/tiny/7.html", "")
    assert (run.folder.path / found.of("tiny", 7)).is_file()


@needs_viser
def test_a_refused_merge_is_named_and_has_no_view(run: RunData) -> None:
    found = write_views(run, "paper", [])
    assert not found.links
    assert found.missing == ("No 3-D view: tiny, seed 7: paper gave no answer, so the maps have no common frame.",)
    with pytest.raises(InputError, match="no common frame"):
        write_case_view(run.folder, ("tiny", 7), "paper", {})


def test_without_the_viewer_the_page_says_how_to_get_the_views(run: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    found = write_views(run, "tunnelcd", [])
    assert "pip install 'tunnelcd[view]'" in found.note
    assert not found.links
    assert not (run.folder.path / "views").exists()
    assert not write_views(run, "tunnelcd", [], "none").links
