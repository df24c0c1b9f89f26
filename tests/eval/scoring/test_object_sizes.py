"""Displacement and volume of matched objects against the truth, worked out by hand and by slow twins."""

import statistics
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import make_pose, stream, yaw_pose
from cdpipe.model.report import ChangedObject, ObjectShape
from eval.scoring.object_metrics import match_objects
from eval.scoring.object_sizes import (
    compute_size_errors,
    find_true_displacements_map,
    find_true_volume_m3,
    summarise_size_errors,
)
from eval.truth.ground_truth import GroundTruth, SessionTruth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import Change, PairTruth
from tests.eval.changes import change

N_SCANS = 11
NAN = float("nan")
# things stand at rows 10 n to 10 n + 9 of their session's scoring points
WIDTH = 10


def change_at(number: int, session: str, kind: str, at: np.ndarray, **fields: object) -> Change:
    ours = {"name": "thing", "world_T_object": at.tolist(), "hull_volume_m3": 2.0}
    return change(number, session, kind, **{**ours, **fields})


def moved(start: np.ndarray, end: np.ndarray, **fields: object) -> list[Change]:
    return [
        change_at(1, "before", "moved", start, partner=2, **fields),
        change_at(2, "after", "moved", end, partner=1, **fields),
    ]


def scoring_points(ids: list[int]) -> ScoringPoints:
    labels = np.repeat(np.array(ids, dtype=np.int16), WIDTH)
    n = len(labels)
    points = np.column_stack([np.arange(n) * 0.1, np.zeros(n), np.zeros(n)]).astype(np.float32)
    return ScoringPoints(np.arange(n, dtype=np.int64), points, labels, np.zeros(n, np.int16), 1, n)


def truth_of(changes: list[Change], odom_T_world: np.ndarray | None = None, **scenario: object) -> GroundTruth:
    """The robot drives x from 0 to 20 m, 2 m a scan; `odom_T_world` holds at every scan, or one for each."""
    world = np.stack([make_pose(translation=(2.0 * index, 0.0, 0.0)) for index in range(N_SCANS)])
    odom = (np.eye(4) if odom_T_world is None else odom_T_world) @ world
    sessions = {
        name: SessionTruth(odom, world, scoring_points([each.id for each in changes if each.session == name] or [0]))
        for name in ("before", "after")
    }
    return GroundTruth(
        pair=PairTruth("test", 0, 4.5, tuple(changes), scenario),
        sessions=sessions,
        change_rows=tuple(sessions[each.session].scoring_points.rows_of_change(each.id) for each in changes),
        centroids_world=np.array([np.array(each.world_T_object)[:3, 3] for each in changes]).reshape(-1, 3),
        is_observable=np.ones(len(changes), dtype=np.bool_),
        is_partial=np.array([each.group == "partial" for each in changes], dtype=np.bool_),
    )


def thing(session: str, *, moved_by: tuple[float, ...] | None = None, volume_m3: float | None = None) -> ChangedObject:
    return ChangedObject(
        session, "added", 0, np.zeros((0, 2), np.int32), np.zeros((0, 3)), 1.0,
        shape=None if volume_m3 is None else ObjectShape(np.eye(4), np.ones(3), volume_m3),
        displacement_map=None if moved_by is None else np.array(moved_by),
    )  # fmt: skip


def errors_of(truth: GroundTruth, objects: list[ChangedObject], places: list[int]) -> tuple[np.ndarray, np.ndarray]:
    rows = [np.arange(WIDTH * place, WIDTH * (place + 1)) for place in places]
    errors = compute_size_errors(objects, match_objects(objects, rows, truth), truth)
    return errors.displacement_m, errors.volume_share


def test_the_error_of_a_displacement_by_hand() -> None:
    truth = truth_of(moved(make_pose(translation=(4.0, 1.0, 0.0)), make_pose(translation=(7.0, 1.0, 0.0))))
    objects = [thing("before", moved_by=(3.0, 0.3, 0.4)), thing("after")]
    displacement_m, _ = errors_of(truth, objects, [0, 0])
    # 0.3 and 0.4 m off to the sides; the other half was matched and says nothing
    np.testing.assert_allclose(displacement_m, [0.5, NAN])


def test_what_is_not_matched_or_never_moved_has_no_displacement() -> None:
    truth = truth_of(
        [change_at(1, "after", "added", np.eye(4)), change_at(2, "after", "moved", np.eye(4), partner=None)]
    )
    assert np.isnan(find_true_displacements_map(truth)).all()
    displacement_m, _ = errors_of(truth, [thing("after", moved_by=(1.0, 0.0, 0.0))], [0])
    assert np.isnan(displacement_m).all()
    assert find_true_displacements_map(truth_of([])).shape == (0, 3)


def test_it_is_the_middle_that_moves_when_a_thing_falls_over() -> None:
    # lying, its own x axis points down: its middle, half its height along its own z, points to world x
    lying = make_pose(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), (4.0, 0.0, 0.0))
    props = [{"name": "thing", "size_m": [0.5, 0.5, 1.0]}, {"name": "mesh", "size_m": None}]
    truth = truth_of(moved(make_pose(translation=(2.0, 0.0, 0.0)), lying), props=props)
    expected = (2.5, 0.0, -0.5)
    np.testing.assert_allclose(find_true_displacements_map(truth), [expected, expected], atol=1e-12)


def test_of_a_prop_from_a_mesh_that_fell_over_nobody_knows_the_middle() -> None:
    lying = make_pose(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), (4.0, 0.0, 0.0))
    props = [{"name": "thing", "size_m": None}]
    assert np.isnan(find_true_displacements_map(truth_of(moved(np.eye(4), lying), props=props))).all()
    turned = truth_of(moved(np.eye(4), yaw_pose(1.0, (4.0, 0.0, 0.0))), props=props)
    np.testing.assert_allclose(find_true_displacements_map(turned)[0], [4.0, 0.0, 0.0], atol=1e-12)


def test_a_prop_of_unknown_height_may_lean_by_two_degrees() -> None:
    props = [{"name": "thing", "size_m": None}]
    for angle_deg, is_known in ((2.0, True), (2.01, False)):
        cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
        leaning = make_pose(np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]), (4.0, 0.0, 0.0))
        found = find_true_displacements_map(truth_of(moved(np.eye(4), leaning), props=props))
        # that of the origin, as nobody knows how far above it the middle is
        np.testing.assert_allclose(found, [[4.0, 0.0, 0.0] if is_known else [np.nan] * 3] * 2, atol=1e-12)


def test_both_halves_say_the_same_and_a_turned_map_turns_it() -> None:
    changes = moved(make_pose(translation=(4.0, 1.0, 0.0)), make_pose(translation=(7.0, 1.0, 0.0)))
    truth = truth_of(changes, yaw_pose(np.pi / 2, (50.0, -3.0, 1.0)))
    np.testing.assert_allclose(find_true_displacements_map(truth), [[0, 3, 0], [0, 3, 0]], atol=1e-12)


def test_drift_between_the_two_places_belongs_to_the_map() -> None:
    # odometry believes 1 % more than it drove: the map puts the far place 0.1 m too far, where the answer sees it too
    stretched = np.stack([make_pose(translation=(0.02 * index, 0.0, 0.0)) for index in range(N_SCANS)])
    truth = truth_of(moved(make_pose(translation=(0.5, 0, 0)), make_pose(translation=(10.5, 0, 0))), stretched)
    np.testing.assert_allclose(find_true_displacements_map(truth)[0], [10.1, 0.0, 0.0])
    displacement_m, _ = errors_of(truth, [thing("before", moved_by=(10.1, 0, 0))], [0])
    assert displacement_m[0] == pytest.approx(0.0, abs=1e-12)
    # of places between two scans, at x = 4 and 6, the nearer one counts
    near = truth_of(moved(make_pose(translation=(4.9, 0, 0)), make_pose(translation=(5.1, 0, 0))), stretched)
    np.testing.assert_allclose(find_true_displacements_map(near)[0], [0.22, 0.0, 0.0], atol=1e-12)


def test_volumes_by_hand() -> None:
    changes = [
        change_at(1, "after", "added", np.eye(4), hull_volume_m3=2.0, mesh_volume_m3=1.6),
        change_at(2, "after", "added", np.eye(4), hull_volume_m3=2.0),
        change_at(3, "after", "added", np.eye(4), hull_volume_m3=0.0),
        change_at(4, "after", "added", np.eye(4)),
        change_at(5, "after", "added", np.eye(4)),
    ]
    objects = [thing("after", volume_m3=volume) for volume in (2.0, 1.5, 1.0, None)]
    _, volume_share = errors_of(truth_of(changes), objects, [0, 1, 2, 3])
    np.testing.assert_allclose(volume_share, [0.25, -0.25, NAN, NAN, NAN])


def test_a_short_move_has_no_volume_and_a_reshaped_pile_that_of_what_is_gone() -> None:
    place = np.eye(4)
    assert np.isnan(find_true_volume_m3(change_at(1, "after", "moved", place, group="partial")))
    assert find_true_volume_m3(change_at(1, "before", "reshaped", place, group="partial", mesh_volume_m3=0.7)) == 0.7
    assert find_true_volume_m3(change_at(1, "after", "moved", place)) == 2.0


def test_columns_are_medians_of_what_is_there() -> None:
    changes = [
        change_at(1, "after", "added", np.eye(4), prop_kind="muck_pile"),
        change_at(2, "after", "added", np.eye(4), prop_kind="muck_pile"),
        change_at(3, "after", "added", np.eye(4)),
    ]
    truth = truth_of(changes)
    objects = [thing("after", volume_m3=volume) for volume in (2.2, 1.4, 20.0)]
    matches = match_objects(objects, [np.arange(WIDTH * i, WIDTH * (i + 1)) for i in range(3)], truth)
    columns = summarise_size_errors(compute_size_errors(objects, matches, truth), truth)
    # piles alone: +10 % and -30 %
    assert columns == pytest.approx({"displacement_error_m": NAN, "pile_volume_error": 0.2}, nan_ok=True)
    none = summarise_size_errors(compute_size_errors([], match_objects([], [], truth), truth), truth)
    assert np.isnan(list(none.values())).all()


def slow_place(truth: GroundTruth, scenario: dict[str, float], each: Change) -> list[float]:
    """Return where the middle of a thing is in the map, from the text: through the truly nearest before keyframe."""
    turn, middle = np.array(each.world_T_object), [0.0, 0.0, 0.0]
    for axis in range(3):
        middle[axis] = turn[axis][3] + turn[axis][2] * scenario.get(each.name, 0.0) / 2
    world, odom = truth.before.world_T_sensor, truth.before.odom_T_sensor
    nearest = min(range(N_SCANS), key=lambda scan: sum((world[scan][i][3] - middle[i]) ** 2 for i in range(3)))
    # seen from that keyframe, then from where odometry believes it was
    seen = [sum(world[nearest][j][i] * (middle[j] - world[nearest][j][3]) for j in range(3)) for i in range(3)]
    return [sum(odom[nearest][i][j] * seen[j] for j in range(3)) + odom[nearest][i][3] for i in range(3)]


@pytest.mark.parametrize("seed", range(20))
def test_errors_of_displacement_and_volume_equal_their_slow_twins(seed: int) -> None:
    draw = stream(seed, "size reference")
    heights = {f"thing {pair}": float(draw.uniform(0.2, 2.0)) for pair in range(3)}
    changes = []
    for pair in range(3):
        for half, session in enumerate(("before", "after")):
            pose = make_pose(Rotation.from_rotvec(draw.normal(0, 0.8, 3)).as_matrix(), draw.uniform(-1, 21, 3))
            changes.append(
                change_at(
                    2 * pair + half + 1, session, "moved", pose, name=f"thing {pair}", partner=2 * pair + 2 - half,
                    prop_kind=str(draw.choice(["box", "muck_pile"])), group=str(draw.choice(["full", "partial"])),
                    hull_volume_m3=float(draw.uniform(0.1, 4)), mesh_volume_m3=draw.choice([None, 0.5, 1.5]),
                )
            )  # fmt: skip
    changes[4:] = [
        replace(each, kind={"after": "added", "before": "removed"}[each.session], partner=None) for each in changes[4:]
    ]
    drift = np.stack([
        make_pose(Rotation.from_rotvec((0, 0, 0.02 * n)).as_matrix(), (0.05 * n, 0.0, 0.01 * n)) for n in range(N_SCANS)
    ])  # fmt: skip
    props = [{"name": name, "size_m": [0.5, 0.5, height]} for name, height in heights.items()]
    truth = truth_of(changes, drift, props=props)
    objects, places = [], []
    for session in ("before", "after"):
        for place in range(3):
            if draw.random() < 0.8:
                said = None if draw.random() < 0.2 else tuple(draw.uniform(-5, 5, 3))
                objects.append(thing(session, moved_by=said, volume_m3=draw.choice([None, 0.4, 2.5])))
                places.append(place)
    rows = [np.arange(WIDTH * place, WIDTH * (place + 1)) for place in places]
    matches = match_objects(objects, rows, truth)
    errors = compute_size_errors(objects, matches, truth)

    of_moves, of_piles = [], []
    for index, each in enumerate(changes):
        own = [
            item
            for item, place in zip(objects, places, strict=True)
            if (item.session, place) == (each.session, index // 2)
        ]
        apart = share = NAN
        if own and own[0].displacement_map is not None and each.kind == "moved":
            start, end = (slow_place(truth, heights, half) for half in changes[index // 2 * 2 : index // 2 * 2 + 2])
            answered = own[0].displacement_map.tolist()
            apart = sum((answered[i] - (end[i] - start[i])) ** 2 for i in range(3)) ** 0.5
            of_moves.append(apart)
        if own and own[0].shape is not None and not (each.kind == "moved" and each.group == "partial"):
            true = each.hull_volume_m3 if each.mesh_volume_m3 is None else each.mesh_volume_m3
            share = (own[0].shape.volume_m3 - true) / true
            of_piles += [abs(share)] if each.prop_kind == "muck_pile" else []
        assert errors.displacement_m[index] == pytest.approx(apart, nan_ok=True, abs=1e-9)
        assert errors.volume_share[index] == pytest.approx(share, nan_ok=True, abs=1e-9)
    expected = {
        "displacement_error_m": statistics.median(of_moves) if of_moves else NAN,
        "pile_volume_error": statistics.median(of_piles) if of_piles else NAN,
    }
    assert summarise_size_errors(errors, truth) == pytest.approx(expected, nan_ok=True, abs=1e-9)
