"""Every limit that an answer must keep: the value at the limit is taken, the next one is refused, and named."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import FARTHEST_M, make_pose
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, ObjectShape
from eval.scoring import answer_check as module
from eval.scoring.answer_check import MAX_AMOUNT, MAX_SECONDS, SECONDS
from eval.truth.ground_truth import SessionTruth
from eval.truth.scoring_points import ScoringPoints
from tests.eval.scoring.test_object_metrics import line_points

NAN, INF = float("nan"), float("inf")
FAR = np.nextafter(FARTHEST_M, np.inf)
TOO_MUCH = np.nextafter(MAX_AMOUNT, np.inf)
POINTS = np.zeros((1, 3))


def taken_or_refused(told: str | None) -> Any:
    """Expect no error, or one that says this."""
    return nullcontext() if told is None else pytest.raises(ValueError, match=told)


def item(session: str = "after", returns: object = (), points: np.ndarray = POINTS, **fields: Any) -> ChangedObject:
    pixels = np.array(returns, dtype=np.int32).reshape(-1, 2)
    return ChangedObject(
        session, "added", **{"region": -1, "returns": pixels, "points_map": points, "score": 1.0, **fields}
    )


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        ({}, None),
        (dict.fromkeys(SECONDS, 0.0), None),
        ({"t_cd_s": MAX_SECONDS}, None),
        ({"t_oe_s": np.nextafter(MAX_SECONDS, INF)}, r"seconds\.t_oe_s = 1"),
        ({"t_cd_s": -1e-300}, r"seconds\.t_cd_s = -1e-300"),
        ({"t_cd_s": NAN}, r"seconds\.t_cd_s = nan"),
        ({"t_cd_s": 1.0, "t_cd": 1.0}, r"seconds\.t_cd is unknown; did you mean"),
    ],
)
def test_seconds(seconds: dict[str, float], told: str | None) -> None:
    with taken_or_refused(told):
        module._check_seconds(seconds)


def test_the_seconds_that_an_answer_may_state() -> None:
    assert SECONDS == (
        "t_index_s", "t_merge_s", "t_refine_s", "t_descriptor_s", "t_cd_s", "t_oe_s", "t_returns_s",
        "t_surface_s",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (0.0, None),
        (NAN, None),
        (MAX_AMOUNT, None),
        (TOO_MUCH, r"evidence\.overlap = "),
        (-1e-300, r"evidence\.overlap = -1e-300"),
        (INF, r"evidence\.overlap = inf"),
    ],
)
def test_evidence(value: float, told: str | None) -> None:
    with taken_or_refused(told):
        module._check_evidence({"agreement": 1.0, "overlap": value})


@pytest.mark.parametrize(
    ("name", "most", "each"),
    [
        ("map_points_before", 50, "one"),
        ("map_points_after", 70, "one"),
        ("bytes_map_before", 3200, "64 bytes"),
        ("bytes_regions_before", 3200, "64 bytes"),
    ],
)
def test_no_more_is_stated_of_a_map_than_its_session_has(name: str, most: float, each: str) -> None:
    told_of = rf"evidence\.{name} = {most}: expected at most {most}, {each} for each pixel"
    for value, told in ((most, None), (NAN, None), (np.nextafter(most, INF), told_of)):
        with taken_or_refused(told):
            module._check_stated({name: value, "overlap": 1e9}, {"before": 50, "after": 70})
    assert module.MAX_BYTES_PER_PIXEL == 64


def test_a_region_asks_for_no_more_points_than_the_session_has() -> None:
    for asked, told in (([0.0, NAN, 50.0], None), ([0.0, NAN, 51.0], r"figure_asked_points: entry 2 is 51: .* 50, ")):
        with taken_or_refused(told):
            module._check_asked({"asked_points": np.array(asked), "others": np.array([1e9])}, 50)
    module._check_asked({}, 50)


def poses(n: int, x_m: float = 0.0) -> np.ndarray:
    return np.stack([make_pose(translation=(0.0, 0.0, x_m))] * n)


@pytest.mark.parametrize(
    ("local", "n_keyframes", "told"),
    [
        (None, 3, None),
        (poses(3), 3, None),
        (poses(5), 0, None),
        (poses(3), 0, "has 3 poses: expected one for each of the 5 scans of the after session"),
        (poses(5), 3, "has 5 poses: expected one for each of the 3 after keyframes"),
        (poses(3, FARTHEST_M), 3, None),
        (poses(3, FAR), 3, "local_before_T_after: entry 0 is farther"),
        (poses(3) * 2, 3, r"local_before_T_after\[0\] is not a rigid"),
        (poses(3) * NAN, 3, "local_before_T_after"),
    ],
)
def test_the_local_merge(local: np.ndarray | None, n_keyframes: int, told: str | None) -> None:
    with taken_or_refused(told):
        module._check_local(local, n_keyframes, 5)


REGIONS = ChangeRegions(
    centres_map=np.full((2, 3), FARTHEST_M),
    radius_m=4.5,
    scores=np.array([2.0, 1.0]),
    pairs=np.zeros((2, 2), np.int64),
    is_reported=np.ones(2, np.bool_),
    keyframe_scores=np.array([1.0, NAN, -3.0]),
)


@pytest.mark.parametrize(
    ("changed", "n_keyframes", "told"),
    [
        ({}, 3, None),
        ({}, 4, "keyframe_scores has 3 entries: expected one for each of the 4 before"),
        ({}, 0, "keyframe_scores has 3 entries: expected one for each of the 5 before"),
        ({"keyframe_scores": np.zeros(5)}, 0, None),
        ({"keyframe_scores": np.zeros(0)}, 3, None),
        ({"keyframe_scores": np.zeros(1)}, 3, "keyframe_scores has 1 entries"),
        ({"keyframe_scores": np.array([0.0, INF, 0.0])}, 3, "keyframe_scores: a score is infinite"),
        ({"keyframe_scores": np.array([0.0, -INF, 0.0])}, 3, "keyframe_scores: a score is infinite"),
        ({"radius_m": 1e-9}, 3, None),
        ({"radius_m": 0.0}, 3, "radius_m = 0.0: "),
        ({"radius_m": FARTHEST_M}, 3, None),
        ({"radius_m": FAR}, 3, "radius_m = 1"),
        ({"radius_m": NAN}, 3, "radius_m = nan: "),
        ({"radius_m": np.array([4.5, FARTHEST_M])}, 3, None),
        ({"radius_m": np.array([4.5, 0.0])}, 3, "radius_m = 0.0: "),
        ({"radius_m": np.array([NAN, 4.5])}, 3, "radius_m = nan: "),
        ({"scores": np.array([INF, 1.0])}, 3, "region_scores: entry 0 is not"),
        ({"scores": np.array([1.0, NAN])}, 3, "region_scores: entry 1 is not"),
        ({"scores": np.array([MAX_AMOUNT, -MAX_AMOUNT])}, 3, None),
        ({"scores": np.array([TOO_MUCH, 1.0])}, 3, r"region_scores: entry 0 is larger than 1e\+15 in size"),
        ({"scores": np.array([1.0, -TOO_MUCH])}, 3, "region_scores: entry 1 is larger"),
        ({"scores": np.array([2, 1], np.uint8), "keyframe_scores": np.array([True, False, True])}, 3, None),
        ({"keyframe_scores": np.array([-MAX_AMOUNT, NAN, MAX_AMOUNT])}, 3, None),
        ({"keyframe_scores": np.array([0.0, TOO_MUCH, NAN])}, 3, "keyframe_scores: entry 1 is larger"),
        ({"centres_map": np.array([(0.0, 0.0, 0.0), (0.0, NAN, 0.0)])}, 3, "region_centres_map: entry 1 is not"),
        ({"centres_map": np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -FAR)])}, 3, "region_centres_map: entry 1 is farther"),
        ({"centres_map": np.array([(0, 0, 0), (0, 0, -(2**63))])}, 3, "region_centres_map: entry 1 is farther"),
        ({"proposed_centres_map": np.zeros((2, 3))}, 3, None),
        (
            {"proposed_centres_map": np.array([(0.0, 0.0, 0.0), (FAR, 0.0, 0.0)])},
            3,
            "^region_proposed_centres_map: entry 1",
        ),
    ],
)
def test_regions(changed: dict[str, Any], n_keyframes: int, told: str | None) -> None:
    with taken_or_refused(told):
        module._check_regions(replace(REGIONS, **changed), n_keyframes, 5)


@pytest.mark.parametrize(
    ("scans", "told"),
    [
        (np.array([0, 4, 2]), None),
        (np.array([3]), None),
        (np.zeros(0), None),
        (np.array([0, 5]), "k names scans 0 to 5, the session has 0 to 4"),
        (np.array([-1, 2]), "k names scans -1 to 2"),
        (np.array([1, 2, 1]), "k names a scan twice"),
        (np.array([1.0]), r"k must be a list of whole numbers, got float64 \(1,\)"),
        (np.array([[1]]), r"k must be a list of whole numbers, got int64 \(1, 1\)"),
        (np.zeros((0, 2)), r"k must be a list of whole numbers, got float64 \(0, 2\)"),
    ],
)
def test_scans(scans: np.ndarray, told: str | None) -> None:
    with taken_or_refused(told):
        module._check_scans("k", scans, 5)


def shape(edge_m: float = 1.0, volume_m3: float = 1.0, x_m: float = 0.0) -> ObjectShape:
    return ObjectShape(make_pose(translation=(x_m, 0.0, 0.0)), np.array([1.0, 1.0, edge_m]), volume_m3)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({}, None),
        ({"partner": 3}, None),
        ({"partner": 0}, None),
        ({"partner": 4}, r"objects\[2\]\.partner = 4: there are 4 objects"),
        ({"partner": -2}, r"objects\[2\]\.partner = -2: there are 4 objects"),
        ({"partner": 2}, r"objects\[2\]\.partner = 2: that is itself"),
        ({"region": 0}, None),
        ({"region": 1}, None),
        ({"region": 2}, r"objects\[2\]\.region = 2: there are 2 regions"),
        ({"region": -2}, r"objects\[2\]\.region = -2: there are 2 regions"),
        ({"points": np.full((2, 3), -FARTHEST_M)}, None),
        ({"points": np.array([(0, 0, 0), (FAR, 0, 0)])}, r"objects\[2\]: object_points_map: entry 1 is farther"),
        ({"points": np.array([(0, 0, 0), (0, 0, INF)])}, r"objects\[2\]: object_points_map: entry 1 is not"),
        ({"score": NAN}, r"objects\[2\]\.score = nan: expected a number"),
        ({"score": -INF}, r"objects\[2\]\.score = -inf: expected a number"),
        ({"score": MAX_AMOUNT}, None),
        ({"score": -TOO_MUCH}, r"objects\[2\]\.score = -1000000000000000\.1: expected a number, at most 1e\+15"),
        ({"shape": shape(0.0, 0.0)}, None),
        ({"shape": shape(FARTHEST_M, MAX_AMOUNT)}, None),
        ({"shape": shape(FAR)}, r"objects\[2\]\.shape: edges 1, 1, 1e\+07 m and volume 1 m3"),
        ({"shape": shape(-0.1)}, r"objects\[2\]\.shape: edges 1, 1, -0.1 m"),
        ({"shape": shape(NAN)}, r"objects\[2\]\.shape: edges 1, 1, nan m"),
        ({"shape": shape(1.0, -0.1)}, "volume -0.1 m3"),
        ({"shape": shape(x_m=-FARTHEST_M)}, None),
        ({"shape": shape(x_m=FAR)}, r"objects\[2\]\.shape: map_T_box: entry 0 is farther"),
        ({"shape": shape(1.0, TOO_MUCH)}, r"volume 1e\+15 m3"),
        ({"displacement_map": np.array([0.0, 0.0, FARTHEST_M])}, None),
        ({"displacement_map": np.array([0.0, 0.0, FAR])}, r"objects\[2\]\.displacement_map: entry 0 is farther"),
        ({"displacement_map": np.array([0.0, NAN, 0.0])}, r"objects\[2\]\.displacement_map: entry 0 is not"),
    ],
)
def test_objects(fields: dict[str, Any], told: str | None) -> None:
    with taken_or_refused(told):
        module._check_object(2, item(**fields), 4, 2)


def session_of(n: int, n_scans: int) -> SessionTruth:
    """Scan 0 returned at each of n pixels, the other scans at none."""
    points = line_points([0] * n)
    posed = np.stack([make_pose(translation=(2.0 * scan, 0.0, 0.0)) for scan in range(n_scans)])
    return SessionTruth(posed, posed, replace(points, n_scans=n_scans))


@pytest.mark.parametrize(
    ("returns", "told"),
    [
        ([[(0, 0), (2, 149)]], None),
        ([[(0, 150)]], r"objects\[1\] names return \(scan 0, pixel 150\), outside .* 3 scans of 150 pixels"),
        ([[(0, 1), (0, -1)]], r"objects\[1\] names return \(scan 0, pixel -1\)"),
        ([[(0, 1), (3, 0)]], r"objects\[1\] names return \(scan 3, pixel 0\)"),
        ([[(-1, 0)]], r"objects\[1\] names return \(scan -1, pixel 0\)"),
        ([[(1, 7), (1, 7)]], r"return \(scan 1, pixel 7\) of the after session twice"),
        ([[(1, 7)], [(0, 1), (1, 7)]], r"return \(scan 1, pixel 7\) of the after session twice"),
        ([[], [(0, 1)]], None),
        ([[], [(1, 7), (1, 7)]], r"return \(scan 1, pixel 7\) of the after session twice"),
        # 99 that did not return may each share a cell with one that did; 100 may not
        ([[(1, pixel) for pixel in range(99)]], None),
        ([[(1, pixel) for pixel in range(100)]], r"nothing returned at any of their 100 \(scan, pixel\)"),
        ([[(1, pixel) for pixel in range(50)], [(2, pixel) for pixel in range(50)]], "any of their 100"),
        ([[*((1, pixel) for pixel in range(100)), (0, 3)]], None),
    ],
)
def test_returns(returns: list[list[tuple[int, int]]], told: str | None) -> None:
    # the object of the other session is none of this session's concern
    objects = (item("before", [(9, 999)]), *(item("after", each) for each in returns))
    with taken_or_refused(told):
        module._check_returns("after", objects, session_of(150, 3))


def test_returns_of_another_type() -> None:
    with pytest.raises(ValueError, match=r"objects\[0\]: object_returns must be whole numbers, got float64"):
        module._check_returns("after", (replace(item(), returns=np.zeros((1, 2))),), session_of(5, 1))
    # large numbers of scans do not overflow
    many = ScoringPoints(
        np.array([70_000 * 40_000]),
        POINTS.astype(np.float32),
        np.zeros(1, np.int16),
        np.zeros(1, np.int16),
        80_000,
        40_000,
    )
    poses_once = np.eye(4)[None]
    twice = item("after", [(70_000, 0), (70_000, 0)])
    with pytest.raises(ValueError, match=r"\(scan 70000, pixel 0\)"):
        module._check_returns("after", (twice,), SessionTruth(poses_once, poses_once, many))


def report_of(objects: list[ChangedObject], local: np.ndarray | None = None) -> ChangeReport:
    none = np.zeros(0)
    regions = ChangeRegions(np.zeros((0, 3)), 1.0, none, np.zeros((0, 2), np.int64), np.zeros(0, np.bool_), none)
    scans = np.zeros(0, np.int64), np.zeros(0, np.int64)
    shift = make_pose(translation=(0.0, 40.0, 0.0))  # before_T_after
    return ChangeReport(shift, {}, regions, tuple(objects), {}, {}, scans, local_before_T_after=local)


def placed(session: str, shift_m: np.ndarray | float) -> ChangedObject:
    """Rows 5 to 14 of a line: a metre along x in the session's own frame, its points moved."""
    rows = np.arange(5, 15)
    own = line_points([0] * 20).points_odom[rows].astype(np.float64)
    return item(session, [(0, pixel) for pixel in rows], own + shift_m)


AFTER_M = np.array([0.0, 40.0, 0.0])
PAIR = {"before": session_of(20, 3), "after": session_of(20, 3)}


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("aside_m", "told"), [(0.4, None), (0.5, None), (0.6, r"2 of 2 objects .*: objects\[0\] is 0\.6 m")]
)
def test_points_beside_their_returns(axis: int, sign: float, aside_m: float, told: str | None) -> None:
    shift_m = sign * aside_m * np.eye(3)[axis]
    for session, known_m in (("before", 0.0), ("after", AFTER_M)):
        with taken_or_refused(None if told is None else f"{told} from its returns in the {session} session"):
            module._check_places(report_of([placed(session, known_m + shift_m)] * 2), PAIR)


@pytest.mark.parametrize(("aside_m", "is_refused"), [(1.9, False), (2.0, False), (2.1, True)])
def test_one_object_alone_may_lie_two_metres_aside(aside_m: float, is_refused: bool) -> None:
    alone = report_of([placed("before", np.array([0.0, 0.0, aside_m]))])
    with taken_or_refused(r"1 of 1 objects .*: objects\[0\] is 2\.1 m" if is_refused else None):
        module._check_places(alone, PAIR)


def test_a_fifth_of_the_returns_beside_their_points_is_enough() -> None:
    # along the line itself: of the ten returns, two are within half a metre of the points at 1.25 m, one at 1.38 m
    module._check_places(report_of([placed("before", np.array([1.25, 0.0, 0.0]))] * 2), PAIR)
    with pytest.raises(ValueError, match=r"2 of 2 objects .* is 0\.[89] m from its returns in the before session"):
        module._check_places(report_of([placed("before", np.array([1.38, 0.0, 0.0]))] * 2), PAIR)


def test_half_of_the_objects_elsewhere_are_too_many() -> None:
    right, wrong = placed("before", 0.0), placed("after", 0.0)
    module._check_places(report_of([right, wrong, right]), PAIR)
    with pytest.raises(ValueError, match=r"1 of 2 objects .*: objects\[1\] is 40\.0 m from its returns in the after"):
        module._check_places(report_of([right, wrong]), PAIR)
    # an object without points or returns says nothing
    mute = [item("before", [(0, 5)], np.zeros((0, 3))), item("before", (), POINTS), item("before", [(2, 5)], POINTS)]
    module._check_places(report_of(mute), PAIR)
    with pytest.raises(ValueError, match=r"1 of 2 objects"):
        module._check_places(report_of([right, wrong, *mute]), PAIR)


@pytest.mark.parametrize(
    ("keyframes", "shifts_m"), [((), (3.0, 7.0, 9.0)), ((0, 2), (3.0, 9.0)), ((2, 0), (9.0, 3.0)), ((1,), (3.0,))]
)
def test_returns_of_the_after_session_are_merged_as_it_holds_at_their_scan(
    keyframes: tuple[int, ...], shifts_m: tuple[float, ...]
) -> None:
    # for each of the three scans, or for each named keyframe; the returns are of scan 0
    local = np.stack([make_pose(translation=(0.0, each, 0.0)) for each in shifts_m])
    for shift_m, told in ((3.0, None), (7.0, "objects do not lie"), (40.0, "objects do not lie")):
        report = replace(report_of([placed("after", np.array([0.0, shift_m, 0.0]))], local), keyframe_scans=(
            np.zeros(0, np.int64), np.array(keyframes, dtype=np.int64)
        ))  # fmt: skip
        with taken_or_refused(told):
            module._check_places(report, PAIR)


def test_the_same_point_many_times_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []
    monkeypatch.setattr(module, "cKDTree", lambda points: sizes.append(len(points)) or cKDTree(points))
    module._check_places(report_of([item("before", [(0, 5)], np.zeros((1_000, 3)))]), PAIR)
    assert sizes == [1]


CELLS = line_points([0] * 20)
ON_CELL_3 = CELLS.points_odom[3:4].astype(np.float64)


@pytest.mark.parametrize(
    ("points", "told"),
    [
        ([ON_CELL_3], None),
        ([np.zeros((0, 3))], None),
        ([ON_CELL_3 + np.array([0.0, 0.0, 0.099])], None),
        ([ON_CELL_3 + np.array([0.0, 0.0, 0.101])], "after session: none of its 1 points is within 0.1 m of a return"),
        ([ON_CELL_3 + 5.0, ON_CELL_3], None),
        ([ON_CELL_3 + 5.0, np.concatenate([ON_CELL_3, ON_CELL_3]) + 7.0], "none of its 2 points"),
        ([ON_CELL_3, np.concatenate([ON_CELL_3 + 0.2, ON_CELL_3])], r"objects\[1\] shares a point"),
        ([ON_CELL_3 - np.array([0.1, 0.0, 0.0]), ON_CELL_3, ON_CELL_3], r"objects\[2\] shares a point"),
        # a point that one object names twice has one owner
        ([np.concatenate([ON_CELL_3, ON_CELL_3])], None),
        ([np.full((2, 3), NAN)], r"objects\[1\]: object_points_odom: entry 0 is not"),
        ([np.full((2, 3), FAR)], r"objects\[1\]: object_points_odom: entry 0 is farther"),
        ([np.zeros((2, 2))], r"objects\[1\]: object_points_odom must be \(N, 3\)|object_points_odom"),
    ],
)
def test_points_of_other_programs(points: list[np.ndarray], told: str | None) -> None:
    # the object of the other session may hold the same point
    objects = (item("before"), *(item("after") for _ in points))
    with taken_or_refused(told):
        module._check_points("after", objects, (ON_CELL_3, *points), CELLS)
    module._check_points("after", objects, None, CELLS)
    module._check_points("before", (item("before"),), (ON_CELL_3,), CELLS)
