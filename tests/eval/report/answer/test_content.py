"""What the page and the view of an answer show, gathered from two sessions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import invert, make_pose, transform
from cdpipe.io.answer import write_answer, write_failure
from cdpipe.io.readers import open_session
from cdpipe.model.report import ChangedObject, SurfaceField
from cdpipe.model.types import PosedScan, WrappedScans
from eval.report.answer.content import MAX_POINTS, _thin_session, gather_content, near_stretches, read_content
from tests.cdpipe.model.test_sentence import EMPTY


def read(pair: Path, folder: Path) -> object:
    return read_content(pair / "before", pair / "after", folder, lambda *_: None)


def test_both_sessions_are_in_the_map_frame(tiny_pair: Path, tiny_merge: np.ndarray, tmp_path: Path) -> None:
    write_answer(tmp_path / "answer", "mine", replace(EMPTY, before_T_after=tiny_merge))
    steps: list[tuple[str, int, int]] = []
    folders = tiny_pair / "before", tiny_pair / "after", tmp_path / "answer"
    content = read_content(*folders, lambda *step: steps.append(step))
    # the same way was driven twice: both paths agree, and both maps do but for the changed things
    np.testing.assert_allclose(content.paths[1], content.paths[0], atol=1e-6)
    after = open_session(tiny_pair / "after")
    own = transform(tiny_merge, transform(after.odom_T_sensor[0], after.scan(0).points_sensor))
    assert np.linalg.norm(content.maps[1][:, None] - own[None, :5], axis=2).min(axis=0).max() < 0.2
    assert content.report.coverage is not None
    assert content.report.coverage.unseen_m == 0.0
    assert content.report.coverage.compared_m == pytest.approx(1.5 * 13)
    assert [step for step in steps if step[1] == step[2]] == [("points before", 14, 14), ("points after", 14, 14)]


class Torn(WrappedScans):
    """An after session with an odometry that jumps back to its start before scan 7."""

    @property
    def jump(self) -> np.ndarray:
        places = super().odom_T_sensor[:, :3, 3]
        return make_pose(translation=places[0] - places[7] + 0.1)

    @property
    def odom_T_sensor(self) -> np.ndarray:
        poses = super().odom_T_sensor.copy()
        poses[7:] = self.jump @ poses[7:]
        return poses

    def scan(self, index: int) -> PosedScan:
        return replace(super().scan(index), odom_T_sensor=self.odom_T_sensor[index])


@pytest.mark.parametrize("every", [1, 2])
def test_a_lost_after_session_lies_where_its_keyframes_were_found(
    tiny_pair: Path, tiny_merge: np.ndarray, every: int
) -> None:
    before, after = (open_session(tiny_pair / name) for name in ("before", "after"))
    keyframes, lost = np.arange(0, 14, every), Torn(after)
    local = np.array([tiny_merge @ (np.eye(4) if scan < 7 else invert(lost.jump)) for scan in keyframes])
    known = {"before_T_after": tiny_merge, "keyframe_scans": (np.arange(14), keyframes)}
    whole = gather_content((before, after), "mine", replace(EMPTY, **known), lambda *_: None)
    torn = replace(EMPTY, **known, local_before_T_after=local)
    content = gather_content((before, lost), "mine", torn, lambda *_: None)
    np.testing.assert_allclose(content.paths[1][: keyframes[-1]], whole.paths[1][: keyframes[-1]], atol=1e-6)
    found, other = cKDTree(whole.maps[1]).query(content.maps[1])[0], cKDTree(content.maps[1]).query(whole.maps[1])[0]
    assert found.max() < 0.2  # thinned on another grid
    assert every > 1 or other.max() < 0.2


def test_large_sessions_are_thinned_until_they_fit(tiny_pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_session(tiny_pair / "before")
    every, cell_m = _thin_session(source, "", lambda *_: None)
    assert (len(every) > 1000, len(every) <= MAX_POINTS, cell_m) == (True, True, 0.1)
    monkeypatch.setattr("eval.report.answer.content.MAX_POINTS", 300)
    few, larger_m = _thin_session(source, "", lambda *_: None)
    assert 100 < len(few) <= 300
    assert larger_m > 0.1
    # one point per cell, each a point of the session
    assert len(np.unique(np.floor(few / larger_m), axis=0)) == len(few)


def test_objects_without_map_points_get_those_of_their_returns(
    tiny_pair: Path, tiny_merge: np.ndarray, tmp_path: Path
) -> None:
    after = open_session(tiny_pair / "after")
    scan = after.scan(3)
    returns = np.array([[3, pixel] for pixel in scan.pixels[[10, 40]]], dtype=np.int32)
    item = ChangedObject("after", "added", -1, returns, np.zeros((0, 3)), 1.0)
    write_answer(tmp_path / "answer", "mine", replace(EMPTY, before_T_after=tiny_merge, objects=(item,)))
    content = read(tiny_pair, tmp_path / "answer")
    expected = transform(tiny_merge, transform(scan.odom_T_sensor, scan.points_sensor[[10, 40]]))
    np.testing.assert_allclose(content.report.objects[0].points_map, expected, atol=1e-9)  # type: ignore[attr-defined]


def test_what_is_no_answer_to_the_pair_is_refused(tiny_pair: Path, tmp_path: Path) -> None:
    write_failure(tmp_path / "failed", "mine", "merge_refused", "too little overlap", {}, {})
    with pytest.raises(InputError, match=r"gave no answer \(merge refused: too little overlap\)"):
        read(tiny_pair, tmp_path / "failed")
    config = {"map": {"keyframe_spacing_m": 1.0}}
    scans = np.arange(14), np.arange(13)
    write_answer(tmp_path / "other", "mine", replace(EMPTY, keyframe_scans=scans, config=config))
    with pytest.raises(InputError, match="13 keyframes up to scan 12, this session 14 up to scan 13"):
        read(tiny_pair, tmp_path / "other")
    with pytest.raises(InputError, match="no such file or folder"):
        read_content(tiny_pair / "absent", tiny_pair / "after", tmp_path / "other", lambda *_: None)


@pytest.mark.parametrize("name", [r"objects\[0\]", "surface_points"])
def test_places_that_no_page_can_show_are_refused(
    name: str, tiny_pair: Path, tiny_merge: np.ndarray, tmp_path: Path
) -> None:
    far = np.array([[0.0, 0.0, 2e5]])
    item = ChangedObject("after", "added", -1, np.array([[3, 10]], dtype=np.int32), far, 1.0)
    rock = SurfaceField(far, np.array([[0.0, 0.0, 1.0]]), np.ones(1), np.ones(1), np.full(1, -1, dtype=np.int32))
    what = {"objects": (item,)} if name.startswith("objects") else {"surface": rock}
    write_answer(tmp_path / "answer", "mine", replace(EMPTY, before_T_after=tiny_merge, **what))
    with pytest.raises(InputError, match=rf"answer: {name} reaches 200000 m from the origin: expected .* 52429 m$"):
        read(tiny_pair, tmp_path / "answer")


@pytest.mark.parametrize(
    ("is_near", "compared", "unseen"),
    [
        ([1, 1, 1], [(0, 3)], []),
        ([0, 0, 0], [], [(0, 3)]),
        ([1, 1, 0, 1, 1], [(0, 2), (3, 5)], [(1, 4)]),
        ([1], [], []),
    ],
)
def test_stretches_by_hand(is_near: list[int], compared: list[tuple[int, int]], unseen: list[tuple[int, int]]) -> None:
    mask = np.array(is_near, dtype=bool)
    for wanted, expected in ((True, compared), (False, unseen)):
        assert [(each.start, each.stop) for each in near_stretches(mask, wanted=wanted)] == expected


def test_the_merge_of_the_fixture_is_the_inverse_of_the_paths(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    before, after = (open_session(tiny_pair / name).odom_T_sensor for name in ("before", "after"))
    np.testing.assert_allclose(before @ invert(after), np.tile(tiny_merge, (14, 1, 1)), atol=1e-6)
