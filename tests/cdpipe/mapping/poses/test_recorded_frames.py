from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, travelled_m, yaw_pose
from cdpipe.mapping.poses.recorded_frames import merge_as_mapped, regions_as_mapped, report_as_recorded
from cdpipe.merge.merge import take_known_merge
from cdpipe.model.config import ExtractConfig, MergeConfig, PipelineConfig, QueryConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import MappedSession, MergedMaps, PointMap
from cdpipe.pipeline import detect_changes, detect_merge

CONFIG = PipelineConfig(
    merge=MergeConfig(voxel_m=0.25), query=QueryConfig(reading="paired", n_regions=40), extract=ExtractConfig()
)


@pytest.fixture(scope="module")
def report(tunnel_before: MappedSession, tunnel_after: MappedSession) -> ChangeReport:
    return detect_changes(tunnel_before, tunnel_after, CONFIG)


def with_recorded(point_map: PointMap, seed: int) -> PointMap:
    """The map as if its scans had been recorded elsewhere: every pose off by decimetres, the whole by metres."""
    rng = stream(seed, "recorded")
    off = make_pose(translation=rng.normal(0, 0.3, (len(point_map.odom_T_sensor), 3)))
    return replace(point_map, recorded_T_sensor=make_pose(translation=(3.0, -2.0, 1.0)) @ point_map.odom_T_sensor @ off)


def test_a_report_on_recorded_poses_stays_itself(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    assert report_as_recorded(report, tunnel_before.map, tunnel_after.map) is report
    assert regions_as_mapped(report.regions, tunnel_before.map) is report.regions


def test_what_a_scan_saw_at_a_keyframe_has_its_place_in_the_recorded_frame(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    before, after = with_recorded(tunnel_before.map, 0), with_recorded(tunnel_after.map, 1)
    told = report_as_recorded(report, before, after)
    assert before.recorded_T_sensor is not None and after.recorded_T_sensor is not None
    scans = before.keyframe_scans
    # regions of queried before keyframes lie at the keyframes
    away_m = np.linalg.norm(before.odom_T_keyframe[:, None, :3, 3] - report.regions.centres_map, axis=2)
    number, region = np.unravel_index(np.argmin(away_m), away_m.shape)
    own = transform(invert(before.odom_T_keyframe[number]), report.regions.centres_map[region][None])
    np.testing.assert_allclose(
        transform(before.recorded_T_sensor[scans[number]], own)[0], told.regions.centres_map[region], atol=1e-9
    )
    # and truth regions go the other way
    back = regions_as_mapped(told.regions, before).centres_map
    assert np.median(np.linalg.norm(back - report.regions.centres_map, axis=1)) < 0.5
    # a point that the after sensor sees at a keyframe is in the before keyframe's frame where it was
    assert told.local_before_T_after is not None
    sensor_points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    for k in (0, 10, 30):
        scan = after.keyframe_scans[k]
        map_points = transform(local_of(report, k), transform(after.odom_T_sensor[scan], sensor_points))
        nearest = int(np.argmin(np.linalg.norm(before.odom_T_keyframe[:, :3, 3] - map_points[0], axis=1)))
        seen = transform(invert(before.odom_T_keyframe[nearest]), map_points)
        recorded = transform(told.local_before_T_after[k], transform(after.recorded_T_sensor[scan], sensor_points))
        again = transform(invert(before.recorded_T_sensor[scans[nearest]]), recorded)
        np.testing.assert_allclose(again, seen, atol=1e-9)


@pytest.mark.parametrize("refine", ["none", "checked"])
def test_a_known_merge_is_one_of_the_recorded_frames(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array, refine: str
) -> None:
    def late(session: MappedSession, lost_m: float) -> MappedSession:
        """The session as if its odometry had lost metres over the first part of the path."""
        poses = session.map.odom_T_sensor
        lost = np.exp(-travelled_m(poses) / 30.0)[:, None] * [0.0, lost_m, 0.0]
        recorded = poses.copy()
        recorded[:, :3, 3] += lost
        return replace(session, map=replace(session.map, recorded_T_sensor=recorded))

    before, after = late(tunnel_before, 1.0), late(tunnel_after, 0.0)
    known = merge_as_mapped(true_before_T_after, before.map, after.map)
    assert not known.is_rigid
    config = CONFIG.model_copy(update={"merge": MergeConfig(voxel_m=0.25, refine=refine)})

    def merge(one: MappedSession, other: MappedSession) -> MergedMaps:
        return take_known_merge(one, other, true_before_T_after, config.merge)

    told = detect_merge(before, after, config, merge=merge)
    if refine == "none":  # the answer is in recorded frames, and has the merge that was given
        assert told.local_before_T_after is not None
        np.testing.assert_allclose(
            told.local_before_T_after, np.broadcast_to(true_before_T_after, told.local_before_T_after.shape), atol=0.05
        )
    # equal poses are no other frame
    same = replace(tunnel_after.map, recorded_T_sensor=tunnel_after.map.odom_T_sensor)
    assert merge_as_mapped(true_before_T_after, tunnel_before.map, same).is_rigid


def local_of(report: ChangeReport, keyframe: int) -> Float64Array:
    return report.before_T_after if report.local_before_T_after is None else report.local_before_T_after[keyframe]


def test_objects_move_as_a_whole_and_displacements_join_their_middles(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    told = report_as_recorded(report, with_recorded(tunnel_before.map, 0), with_recorded(tunnel_after.map, 1))
    shifts = []
    for item, moved in zip(report.objects, told.objects, strict=True):
        shift = moved.points_map - item.points_map
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-9)
        shifts.append(shift[0])
        assert item.shape is not None and moved.shape is not None
        np.testing.assert_allclose(moved.shape.map_T_box[:3, 3], item.shape.map_T_box[:3, 3] + shift[0])
        np.testing.assert_array_equal(moved.shape.map_T_box[:3, :3], item.shape.map_T_box[:3, :3])
        np.testing.assert_array_equal(moved.returns, item.returns)
    assert np.ptp([np.linalg.norm(shift) for shift in shifts]) > 0.05  # each by its own keyframe
    pairs = [(k, item) for k, item in enumerate(report.objects) if item.partner >= 0]
    assert pairs
    for k, item in pairs:
        assert item.displacement_map is not None and told.objects[k].displacement_map is not None
        sign = 1 if item.session == "before" else -1
        expected = item.displacement_map + sign * (shifts[item.partner] - shifts[k])
        np.testing.assert_allclose(told.objects[k].displacement_map, expected, atol=1e-9)


def test_answers_of_the_pipeline_are_in_the_recorded_frames(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    before = replace(tunnel_before, map=with_recorded(tunnel_before.map, 0))
    after = replace(tunnel_after, map=with_recorded(tunnel_after.map, 1))
    told = detect_changes(before, after, CONFIG)
    expected = report_as_recorded(report, before.map, after.map)
    np.testing.assert_array_equal(told.regions.centres_map, expected.regions.centres_map)
    np.testing.assert_array_equal(told.local_before_T_after, expected.local_before_T_after)
    np.testing.assert_array_equal(
        detect_merge(before, after, CONFIG).local_before_T_after, expected.local_before_T_after
    )
    # regions that are told in the recorded frame find the same objects
    proposed = replace(expected.regions, is_withdrawn=None)
    given = detect_changes(before, after, CONFIG, propose=lambda scans, radii_m: proposed)
    assert {item.kind for item in given.objects} == {item.kind for item in report.objects}


def test_proposed_centres_move_each_by_its_own_keyframe(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    before, after = with_recorded(tunnel_before.map, 0), with_recorded(tunnel_after.map, 1)
    assert before.recorded_T_sensor is not None
    # every region was proposed at a keyframe, and was then centred elsewhere
    keyframes = np.arange(len(report.regions.scores)) % len(before.keyframe_scans)
    regions = replace(report.regions, proposed_centres_map=before.odom_T_keyframe[keyframes, :3, 3])
    told = report_as_recorded(replace(report, regions=regions), before, after).regions
    recorded = before.recorded_T_sensor[before.keyframe_scans][keyframes, :3, 3]
    assert told.proposed_centres_map is not None
    np.testing.assert_allclose(told.proposed_centres_map, recorded, atol=1e-9)
    back = regions_as_mapped(replace(report.regions, proposed_centres_map=recorded), before).proposed_centres_map
    np.testing.assert_allclose(back, regions.proposed_centres_map, atol=1e-9)


def test_the_rigid_merge_of_an_answer_is_one_of_the_recorded_frames(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    def turned(point_map: PointMap, yaw_rad: float, shift_m: tuple[float, float, float]) -> PointMap:
        return replace(point_map, recorded_T_sensor=yaw_pose(yaw_rad, shift_m) @ point_map.odom_T_sensor)

    before = turned(tunnel_before.map, 0.5, (3.0, -2.0, 1.0))
    after = turned(tunnel_after.map, -0.3, (-1.0, 4.0, 0.0))
    told = report_as_recorded(replace(report, local_before_T_after=None), before, after)
    # what the recordings differ by, about the merge of the maps
    expected = yaw_pose(0.5, (3.0, -2.0, 1.0)) @ report.before_T_after @ invert(yaw_pose(-0.3, (-1.0, 4.0, 0.0)))
    np.testing.assert_allclose(told.before_T_after, expected, atol=1e-9)
    # equal poses are no other frame: not a bit changes
    same = [replace(each.map, recorded_T_sensor=each.map.odom_T_sensor) for each in (tunnel_before, tunnel_after)]
    np.testing.assert_array_equal(report_as_recorded(report, *same).before_T_after, report.before_T_after)


def test_the_rigid_merge_fits_where_both_sessions_were(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    # the after session was alone on the second half of its path, where its odometry went astray
    poses = tunnel_after.map.odom_T_sensor
    alone = travelled_m(poses) > travelled_m(poses)[-1] / 2
    recorded = poses.copy()
    recorded[alone] = make_pose(translation=(0.0, 9.0, 0.0)) @ poses[alone]
    after = replace(tunnel_after.map, recorded_T_sensor=recorded)
    map_T_sensor = report.before_T_after @ poses
    gaps_m, _ = cKDTree(map_T_sensor[alone, :3, 3]).query(tunnel_before.map.odom_T_sensor[:, :3, 3])
    kept = np.flatnonzero(gaps_m[tunnel_before.map.keyframe_scans] > 6.0)
    assert len(kept) > 5
    before = replace(
        tunnel_before.map,
        keyframe_scans=tunnel_before.map.keyframe_scans[kept],
        views=None,
    )
    told = report_as_recorded(replace(report, local_before_T_after=None), before, after)
    np.testing.assert_allclose(told.before_T_after, report.before_T_after, atol=1e-6)


@pytest.mark.parametrize("is_before", [True, False])
def test_the_rigid_merge_fits_where_the_odometry_kept_its_way(
    report: ChangeReport, tunnel_before: MappedSession, tunnel_after: MappedSession, is_before: bool
) -> None:
    session = tunnel_before if is_before else tunnel_after
    recorded = session.map.odom_T_sensor.copy()
    n_lost = len(recorded) // 3
    for number in range(n_lost):  # steps of 3 m to another side each
        recorded[len(recorded) - n_lost + number, :3, 3] += np.array([0.0, 3.0, 1.0]) * (number + 1)
    lost = replace(session.map, recorded_T_sensor=recorded)
    before, after = (lost, tunnel_after.map) if is_before else (tunnel_before.map, lost)
    told = report_as_recorded(report, before, after)
    off = invert(report.before_T_after) @ told.before_T_after
    assert np.linalg.norm(off[:3, 3]) < 0.3


@pytest.mark.parametrize("refine", ["none", "checked"])
@pytest.mark.parametrize("is_before", [True, False])
def test_a_known_merge_holds_where_an_odometry_lost_its_way(
    tunnel_before: MappedSession,
    tunnel_after: MappedSession,
    true_before_T_after: Float64Array,
    refine: str,
    is_before: bool,
) -> None:
    def spun(session: MappedSession, share: float) -> MappedSession:
        recorded = session.map.odom_T_sensor.copy()
        for number in range(int(len(recorded) * (1 - share)), len(recorded)):
            recorded[number] = recorded[number - 1] @ yaw_pose(np.deg2rad(58.0), (4.5, 0.5, 0.1))
        return replace(session, map=replace(session.map, recorded_T_sensor=recorded))

    before, after = spun(tunnel_before, 0.3 * is_before), spun(tunnel_after, 0.3 * (not is_before))
    config = MergeConfig(voxel_m=0.25, refine=refine)
    merged = take_known_merge(before, after, true_before_T_after, config)
    places = tunnel_after.map.odom_T_keyframe[:, :3, 3]  # the maps are the mended ones
    assert merged.local is not None
    off_m = np.linalg.norm(merged.local.to_map(places) - transform(true_before_T_after, places), axis=1)
    assert off_m.max() < 0.05


@pytest.mark.parametrize(("at", "is_of_the_end"), [(0.65, True), (0.3, False)])
def test_a_known_merge_is_one_of_the_stretch_under_which_the_sessions_met(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array, at: float,
    is_of_the_end: bool,
) -> None:  # fmt: skip
    """The before odometry jumps aside by 8 m; the merge is true before the jump, or behind it."""
    mapped, first = tunnel_before.map.odom_T_sensor, int(len(tunnel_before.map.odom_T_sensor) * at)
    recorded = mapped.copy()
    recorded[first:, 1, 3] += 8.0
    before, known, keyframes = replace(tunnel_before.map, recorded_T_sensor=recorded), true_before_T_after, slice(None)
    if is_of_the_end:  # the after session saw only what lies behind
        known = make_pose(translation=(0.0, 8.0, 0.0)) @ known
        along_m = transform(true_before_T_after, tunnel_after.map.odom_T_keyframe[:, :3, 3])[:, 0]
        keyframes = np.flatnonzero(along_m > mapped[first, 0, 3] + 2.0)
    after = replace(tunnel_after.map, keyframe_scans=tunnel_after.map.keyframe_scans[keyframes], views=None)
    places = after.odom_T_keyframe[:, :3, 3]
    found = merge_as_mapped(known, before, after)
    np.testing.assert_allclose(found.to_map(places), transform(true_before_T_after, places), atol=1e-6)
