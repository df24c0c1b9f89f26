"""What holds for every metric, whatever the pair and the answer: drawn pairs, drawn answers (hypothesis)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from cdpipe.core.geometry import invert, make_pose, stream, transform, transform_each, yaw_pose
from cdpipe.io.answer import Answer
from cdpipe.model.config import QueryConfig
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from eval.oracles.regions import regions_by_truth
from eval.scoring.object_sizes import find_true_displacements_map
from eval.scoring.scoring import score_answer
from eval.truth.ground_truth import GroundTruth, SessionTruth, ground_truth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import PairTruth
from tests.eval.changes import change

N_SCANS, N_PIXELS = 24, 32
RADIUS_M = 3.0
SHARES = (
    "region_recall", "region_precision", "region_recall_at_k", "region_recall_proposed", "region_precision_proposed",
    "region_recall_at_k_proposed", "region_auroc", "region_ap", "object_iou_point", "object_iou_voxel",
    "object_iou_box", "object_f1_25", "object_f1_50", "object_precision_50", "object_pq", "kind_accuracy",
    "object_iou_point_partial", "dynamic_accuracy", "associated_accuracy",
)  # fmt: skip
# boxes and voxels lie along the axes of odom, so a turn moves them
ALONG_AXES = ("object_iou_voxel", "object_iou_box")
ERRORS = ("false_regions_per_100m", "false_regions_per_100m_proposed", "merge_error_m", "merge_error_deg")
SEEDS = st.integers(0, 10_000)
# a smaller seed is no simpler pair, so nothing is shrunk
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True, phases=(Phase.generate,))


def drawn_truth(seed: int, *, has_changes: bool = True) -> GroundTruth:
    """Two drifting drives through a bent tunnel, up to five changes, some of them moved, partial or unobservable."""
    draw = stream(seed, "properties")
    changes = []
    if has_changes:
        for number in range(1, int(draw.integers(2, 6))):
            session = ("before", "after")[int(draw.integers(2))]
            kind = "removed" if session == "before" else "added"
            fields: dict[str, Any] = {"group": "partial" if draw.random() < 0.2 else "full"}
            changes.append(change(number, session, kind, is_observable=bool(draw.random() < 0.85), **fields))
        moved = [next((each for each in changes if each.session == name), None) for name in ("before", "after")]
        if None not in moved and draw.random() < 0.5:
            first, second = (replace(each, kind="moved", group="full") for each in moved)
            first, second = replace(first, partner=second.id), replace(second, partner=first.id)
            changes = [{first.id: first, second.id: second}.get(each.id, each) for each in changes]
    sessions = {name: drawn_session(draw, [c.id for c in changes if c.session == name]) for name in ("before", "after")}
    return ground_truth(PairTruth("test", seed, RADIUS_M, tuple(changes), {}), sessions)


def drawn_session(draw: np.random.Generator, ids: Sequence[int]) -> SessionTruth:
    """A drive along x; each change fills some cells beside the path, the rest are walls."""
    along = np.cumsum(draw.uniform(0.6, 1.4, N_SCANS)) - 1.0
    world = np.stack([yaw_pose(0.02 * x, (x, 0.3 * np.sin(x / 3), 1.0)) for x in along])
    odom_T_world = yaw_pose(draw.uniform(-3, 3), draw.uniform(-20, 20, 3))
    slip = np.stack([yaw_pose(2e-4 * k, (0.004 * k, 0.0, 0.0)) for k in range(N_SCANS)])
    odom = odom_T_world @ slip @ world
    scans = np.repeat(np.arange(N_SCANS), N_PIXELS)
    n = len(scans)
    sides = np.where(draw.random(n) < 0.5, -4.0, 4.0)
    points_sensor = np.column_stack([draw.uniform(-0.5, 0.5, n), sides, draw.uniform(-1, 2, n)])
    labels = np.zeros(len(scans), dtype=np.int16)
    for number in ids:
        middle, n = int(draw.integers(2, N_SCANS - 2)), int(draw.integers(4, 20))
        rows = (middle * N_PIXELS + draw.choice(N_PIXELS, n, replace=False)).astype(np.int64)
        rows = rows[labels[rows] == 0]
        labels[rows] = number
        points_sensor[rows] = draw.uniform(-2, 2, 3) + draw.uniform(-0.4, 0.4, (len(rows), 3))
    points_odom = transform_each(odom[scans], points_sensor)
    points = ScoringPoints(
        np.arange(len(scans), dtype=np.int64), points_odom.astype(np.float32), labels, labels, N_SCANS, N_PIXELS
    )
    return SessionTruth(odom, world, points)


def objects_of(truth: GroundTruth, rows: Sequence[np.ndarray]) -> tuple[ChangedObject, ...]:
    """An object for each change, made of the given rows of its session; unobservable ones as well."""
    place = {each.id: index for index, each in enumerate(truth.pair.changes)}
    moves = find_true_displacements_map(truth)
    objects = []
    for index, (each, of_object) in enumerate(zip(truth.pair.changes, rows, strict=True)):
        points = truth.sessions[each.session].scoring_points
        returns = np.column_stack([points.scans(of_object), points.pixels(of_object)]).astype(np.int32)
        partner = -1 if each.partner is None else place[each.partner]
        at = points.points_odom[of_object].astype(np.float64)
        moved = moves[index] if each.partner is not None else None
        objects.append(ChangedObject(each.session, each.kind, -1, returns, at, 1.0, partner, displacement_map=moved))
    return tuple(objects)


def true_local(truth: GroundTruth) -> np.ndarray:
    """The alignment that is right at each judged after scan, given its truly nearest judged before scan."""
    before, after = truth.before, truth.after
    i, j = before.judged_scans, after.judged_scans
    at_i, at_j = before.world_T_sensor[i][:, :3, 3], after.world_T_sensor[j][:, :3, 3]
    gaps = np.linalg.norm(at_i[:, None] - at_j, axis=2)
    i = i[gaps.argmin(axis=0)]
    true_i_T_j = invert(before.world_T_sensor[i]) @ after.world_T_sensor[j]
    return before.odom_T_sensor[i] @ true_i_T_j @ invert(after.odom_T_sensor[j])


def true_report(truth: GroundTruth) -> ChangeReport:
    scans = truth.before.judged_scans, truth.after.judged_scans
    regions = regions_by_truth(
        truth, scans, np.full(len(scans[0]), RADIUS_M), QueryConfig(radius_m=RADIUS_M, suppression=1e-9)
    )
    local = true_local(truth)
    return ChangeReport(
        local[0], {}, regions, objects_of(truth, truth.change_rows), {}, {}, scans, local_before_T_after=local
    )


def drawn_report(truth: GroundTruth, seed: int) -> ChangeReport:
    """A middling answer: some regions right, some wrong, some withdrawn; cut objects; a merge that is off."""
    draw, report = stream(seed, "answer"), true_report(truth)
    true = report.regions.centres_map
    n_wrong = int(draw.integers(0, 5))
    centres = np.concatenate([true + draw.normal(0, 1.0, true.shape), draw.uniform(-30, 30, (n_wrong, 3))])
    centres = centres[draw.permutation(len(centres))]
    n = len(centres)
    is_reported = draw.random(n) < 0.6
    regions = ChangeRegions(
        centres, RADIUS_M, np.sort(draw.normal(size=n))[::-1], np.zeros((n, 2), np.int64), is_reported,
        draw.normal(size=len(truth.before.judged_scans)), is_withdrawn=~is_reported & (draw.random(n) < 0.5),
    )  # fmt: skip
    rows, walls = [], {name: np.flatnonzero(s.scoring_points.change == 0) for name, s in truth.sessions.items()}
    for each, of_change in zip(truth.pair.changes, truth.change_rows, strict=True):
        extra = draw.choice(walls[each.session], int(draw.integers(0, 8)), replace=False)
        walls[each.session] = np.setdiff1d(walls[each.session], extra)
        rows.append(np.sort(np.concatenate([of_change[draw.random(len(of_change)) < 0.8], extra])))
    slip = make_pose(translation=draw.normal(0, 0.1, 3))
    local = report.local_before_T_after @ slip
    return replace(report, regions=regions, objects=objects_of(truth, rows), local_before_T_after=local)


def row_of(truth: GroundTruth, report: ChangeReport) -> dict[str, Any]:
    return score_answer(Answer("ok", "", "drawn", report, {}, {}), truth).row


def without_anything(report: ChangeReport) -> ChangeReport:
    nothing = ChangeRegions(
        np.zeros((0, 3)), RADIUS_M, np.zeros(0), np.zeros((0, 2), np.int64), np.zeros(0, np.bool_), np.zeros(0)
    )
    return replace(report, regions=nothing, objects=())


def numbers(row: dict[str, Any], names: Sequence[str]) -> dict[str, float]:
    return {name: float(row[name]) for name in names}


@EXAMPLES
@given(SEEDS)
def test_the_truth_scores_exactly_one(seed: int) -> None:
    truth = drawn_truth(seed)
    row = row_of(truth, true_report(truth))
    # NaN only where the truth has nothing to ask, as for every other answer
    asked = numbers(row_of(truth, without_anything(true_report(truth))), SHARES)
    expected = {name: value if np.isnan(value) else 1.0 for name, value in asked.items()}
    assert numbers(row, SHARES) == pytest.approx(expected, nan_ok=True, abs=0)
    assert row["false_regions_per_100m"] == 0.0
    assert numbers(row, ("merge_error_m", "merge_error_deg")) == pytest.approx(
        {"merge_error_m": 0.0, "merge_error_deg": 0.0}, abs=1e-5
    )
    assert np.isnan(row["displacement_error_m"]) or row["displacement_error_m"] == pytest.approx(0.0, abs=1e-9)


@EXAMPLES
@given(SEEDS)
def test_an_empty_answer_scores_zero_and_chance(seed: int) -> None:
    truth = drawn_truth(seed)
    row = row_of(truth, without_anything(true_report(truth)))
    for name in SHARES:
        if name == "region_auroc":
            assert np.isnan(row[name]) or row[name] == 0.5
        elif name != "region_ap":
            assert np.isnan(row[name]) or row[name] == 0.0
    assert np.isnan(row["region_recall"]) == (truth.n_observable == 0)
    failed = score_answer(Answer("merge_refused", "", "drawn", None, {}, {}), truth).row
    assert numbers(failed, SHARES) == pytest.approx(numbers(row, SHARES), nan_ok=True)


@EXAMPLES
@given(SEEDS)
def test_on_an_unchanged_pair_only_silence_is_right(seed: int) -> None:
    truth = drawn_truth(seed, has_changes=False)
    silent = row_of(truth, without_anything(true_report(truth)))
    assert all(np.isnan(silent[name]) for name in SHARES)
    assert (silent["is_alarm"], silent["false_regions_per_100m"]) == (False, 0.0)
    loud = row_of(truth, with_wrong_region(truth, without_anything(true_report(truth)), 0))
    assert (loud["is_alarm"], loud["region_precision"]) == (True, 0.0)
    assert loud["false_regions_per_100m"] > 0.0


def moved_points(points: ScoringPoints, move: np.ndarray) -> ScoringPoints:
    moved = transform(move, points.points_odom.astype(np.float64))
    return replace(points, points_odom=moved.astype(np.float32))


@EXAMPLES
@given(SEEDS)
def test_moving_both_sessions_changes_no_score(seed: int) -> None:
    truth = drawn_truth(seed)
    report, draw = drawn_report(truth, seed), stream(seed, "move")
    world, before, after = (yaw_pose(draw.uniform(-3, 3), draw.uniform(-50, 50, 3)) for _ in range(3))
    sessions = {
        name: SessionTruth(
            move @ session.odom_T_sensor,
            world @ session.world_T_sensor,
            moved_points(session.scoring_points, move),
        )
        for (name, session), move in zip(truth.sessions.items(), (before, after), strict=True)
    }
    changes = [
        replace(each, world_T_object=(world @ np.array(each.world_T_object)).tolist()) for each in truth.pair.changes
    ]
    moved_truth = ground_truth(replace(truth.pair, changes=tuple(changes)), sessions)
    turn = before[:3, :3]
    objects = [
        item if (shift := item.displacement_map) is None else replace(item, displacement_map=turn @ shift)
        for item in report.objects
    ]
    moved = replace(
        report,
        before_T_after=before @ report.before_T_after @ invert(after),
        local_before_T_after=before @ report.local_before_T_after @ invert(after),
        regions=replace(report.regions, centres_map=transform(before, report.regions.centres_map)),
        objects=tuple(objects),
    )
    names = [*(name for name in SHARES if name not in ALONG_AXES), *ERRORS, "region_coverage", "displacement_error_m"]
    ours, theirs = row_of(truth, report), row_of(moved_truth, moved)
    assert numbers(theirs, names) == pytest.approx(numbers(ours, names), nan_ok=True, abs=1e-4)


@EXAMPLES
@given(SEEDS)
def test_the_order_of_objects_returns_and_keyframes_changes_no_score(seed: int) -> None:
    truth = drawn_truth(seed)
    report, draw = drawn_report(truth, seed), stream(seed, "order")
    order = draw.permutation(len(report.objects))
    place = {int(old): new for new, old in enumerate(order)}
    objects = [report.objects[int(old)] for old in order]
    objects = [replace(item, partner=place.get(item.partner, -1)) for item in objects]
    objects = [replace(item, returns=draw.permutation(item.returns)) for item in objects]
    of_before, of_after = (draw.permutation(len(scans)) for scans in report.keyframe_scans)
    shuffled = replace(
        report,
        objects=tuple(objects),
        regions=replace(report.regions, keyframe_scores=report.regions.keyframe_scores[of_before]),
        keyframe_scans=(report.keyframe_scans[0][of_before], report.keyframe_scans[1][of_after]),
        local_before_T_after=report.local_before_T_after[of_after],
    )
    names = [*SHARES, *ERRORS, "region_coverage", "displacement_error_m", "n_matched"]
    assert numbers(row_of(truth, shuffled), names) == pytest.approx(
        numbers(row_of(truth, report), names), nan_ok=True, abs=1e-12
    )


@EXAMPLES
@given(SEEDS, st.floats(0.0, 1.0), st.floats(0.02, 0.05))
def test_the_phase_of_an_answers_thinning_changes_no_score(seed: int, phase: float, voxel_m: float) -> None:
    """An answer of points, dense over each row and thinned by any grid, names the rows that it covers."""
    truth = drawn_truth(seed)
    report = true_report(truth)
    whole, thinned = [], []
    for item in report.objects:
        around = stream(seed, "dense").uniform(-0.02, 0.02, (30, 3))
        dense = (item.points_map[:, None] + around).reshape(-1, 3)
        _, first = np.unique(np.floor(dense / voxel_m + phase).astype(np.int64), axis=0, return_index=True)
        whole.append(dense)
        thinned.append(dense[np.sort(first)])
    unnamed = tuple(replace(item, returns=np.zeros((0, 2), np.int32)) for item in report.objects)
    bare = replace(report, objects=unnamed)
    answers = [Answer("ok", "", "", bare, {}, {}, points_odom=tuple(points)) for points in (whole, thinned)]
    names = [name for name in SHARES if name.startswith(("object", "kind"))]
    scores = [numbers(score_answer(answer, truth).row, names) for answer in answers]
    assert scores[0] == pytest.approx(scores[1], nan_ok=True, abs=0.1)


def with_wrong_region(truth: GroundTruth, report: ChangeReport, seed: int) -> ChangeReport:
    """Put a reported region 200 m from everything among the candidates, at any rank."""
    regions, draw = report.regions, stream(seed, "wrong")
    score = float(draw.normal()) if len(regions.scores) else 0.0
    place = int(np.searchsorted(-regions.scores, -score))
    added = replace(
        regions,
        centres_map=np.insert(regions.centres_map, place, [200.0, 200.0, 200.0], axis=0),
        scores=np.insert(regions.scores, place, score),
        pairs=np.insert(regions.pairs, place, 0, axis=0),
        is_reported=np.insert(regions.is_reported, place, True),
        is_withdrawn=None if regions.is_withdrawn is None else np.insert(regions.is_withdrawn, place, False),
    )
    return replace(report, regions=added)


def with_wrong_object(truth: GroundTruth, report: ChangeReport, seed: int) -> ChangeReport:
    """Add an object on walls that no other object holds."""
    points = truth.after.scoring_points
    held = [points.rows_of_returns(item.returns) for item in report.objects if item.session == "after"]
    free = np.setdiff1d(np.flatnonzero(points.change == 0), np.concatenate([np.zeros(0, np.int64), *held]))
    rows = np.sort(stream(seed, "wrong").choice(free, 12, replace=False))
    returns = np.column_stack([points.scans(rows), points.pixels(rows)]).astype(np.int32)
    at = points.points_odom[rows].astype(np.float64)
    return replace(report, objects=(*report.objects, ChangedObject("after", "added", -1, returns, at, 1.0)))


@EXAMPLES
@given(SEEDS, st.sampled_from([with_wrong_region, with_wrong_object]), st.booleans())
def test_something_wrong_never_raises_a_score(seed: int, add: Any, is_empty: bool) -> None:
    truth = drawn_truth(seed)
    report = drawn_report(truth, seed)
    if is_empty:
        report = without_anything(report)
    before, after = row_of(truth, report), row_of(truth, add(truth, report, seed))
    for name in SHARES:
        assert after[name] <= before[name] or np.isnan(before[name]), name
        assert not np.isnan(after[name]) or np.isnan(before[name]), name
    for name in ERRORS:
        assert after[name] >= before[name] or np.isnan(before[name]), name


@EXAMPLES
@given(SEEDS)
def test_a_region_given_twice_counts_once(seed: int) -> None:
    truth = drawn_truth(seed)
    report = drawn_report(truth, seed)
    regions = report.regions
    twice = np.repeat(np.arange(len(regions.scores)), 2)
    assert regions.is_withdrawn is not None
    doubled = replace(
        regions, centres_map=regions.centres_map[twice], scores=regions.scores[twice], pairs=regions.pairs[twice],
        is_reported=regions.is_reported[twice], is_withdrawn=regions.is_withdrawn[twice],
    )  # fmt: skip
    once, again = row_of(truth, report), row_of(truth, replace(report, regions=doubled))
    same = ("region_recall", "region_recall_proposed", "n_true_regions", "n_found_changes", "region_coverage")
    assert numbers(again, same) == pytest.approx(numbers(once, same), nan_ok=True)
    for name in SHARES:
        assert again[name] <= once[name] or np.isnan(once[name]), name


@EXAMPLES
@given(SEEDS)
def test_every_share_is_a_share(seed: int) -> None:
    truth = drawn_truth(seed)
    row = row_of(truth, drawn_report(truth, seed))
    for name in (*SHARES, "region_coverage", "keyframe_coverage", "overlap_true"):
        assert np.isnan(row[name]) or 0.0 <= row[name] <= 1.0, name
    if truth.n_observable:
        never_nan = [name for name in SHARES if name.startswith("region_r") or name == "kind_accuracy"]
        assert not np.isnan([row[name] for name in never_nan]).any()


@EXAMPLES
@given(SEEDS)
def test_accuracies_of_points_pay_neither_silence_nor_noise(seed: int) -> None:
    truth = drawn_truth(seed)
    report = true_report(truth)
    right, silent = row_of(truth, report), row_of(truth, without_anything(report))
    # objects on unobservable and partial changes hold no static point
    assert (right["static_accuracy"], silent["static_accuracy"]) == (1.0, 1.0)
    wrong = row_of(truth, with_wrong_object(truth, report, seed))
    assert wrong["static_accuracy"] < 1.0
    assert wrong["dynamic_accuracy"] == right["dynamic_accuracy"] or np.isnan(right["dynamic_accuracy"])
    everything = [np.arange(len(truth.sessions[name].scoring_points)) for name in ("before", "after")]
    points = [truth.sessions[name].scoring_points for name in ("before", "after")]
    objects = tuple(
        ChangedObject(name, "added", -1, np.column_stack([of.scans(rows), of.pixels(rows)]).astype(np.int32),
                      of.points_odom[rows].astype(np.float64), 1.0)
        for name, of, rows in zip(("before", "after"), points, everything, strict=True)
    )  # fmt: skip
    loud = row_of(truth, replace(report, objects=objects))
    assert loud["static_accuracy"] == 0.0
    for row in (silent, loud):
        assert np.isnan(row["associated_accuracy"]) or row["associated_accuracy"] == 0.0
