"""The rivals that ask for normals, rays or range images, in a room of known boxes; some need an extra."""

import importlib.util
import logging
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, make_pose, stream, transform, yaw_pose
from cdpipe.methods.dufomap import dufomap
from cdpipe.methods.m3c2 import Distances, m3c2
from cdpipe.methods.m3c2_ep import detection_levels, m3c2_ep
from cdpipe.methods.octomap import near_origin, octomap
from cdpipe.methods.whole_map import PlacedMaps
from cdpipe.model.config import M3C2EPConfig, load_config
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, SessionName
from cdpipe.pipeline import detect_changes
from eval.running.stages.pair_stages import kept_bytes
from tests.cdpipe.rooms import Box, RoomScans

Command = Callable[..., tuple[int, str, str]]
PACKAGES = {"m3c2": "py4dgeo", "m3c2-ep": "py4dgeo", "dufomap": "dufomap", "octomap": "pyoctomap"}
# The room has seven scans, fewer than the presets leave out.
# the normals of the presets are those of a drift: in this room they take a rim of floor with the crate
SETTINGS_OF = {
    "octomap": ("octomap.every_scan=1",),
    "removert": ("removert.every_scan=1",),
    "m3c2": ("m3c2.normal_m=1",),
    "m3c2-ep": ("m3c2.normal_m=1",),
}


def needs(method: str) -> pytest.MarkDecorator:
    is_missing = importlib.util.find_spec(PACKAGES[method]) is None
    return pytest.mark.skipif(is_missing, reason=f"needs the extra `{method}`: {PACKAGES[method]}")


every = pytest.mark.parametrize("method", ["removert", *(pytest.param(name, marks=needs(name)) for name in PACKAGES)])

CRATE: Box = ((1.0, 1.2, 0.0), (1.8, 2.2, 0.9))
ODOM_T_ROOM = yaw_pose(0.7, (3.0, -2.0, 0.5))
SETTINGS = ("query.threshold=0", "query.radius_m=6", "map.keyframe_spacing_m=0.5")


@pytest.fixture(scope="module", name="empty")
def empty_fixture() -> PointMap:
    return RoomScans([], 1).mapped()


@pytest.fixture(scope="module", name="crated_scans")
def crated_scans_fixture() -> RoomScans:
    return RoomScans([CRATE], 3, odom_T_room=ODOM_T_ROOM)


@pytest.fixture(scope="module", name="crated")
def crated_fixture(crated_scans: RoomScans) -> PointMap:
    return crated_scans.mapped()


def descriptors(point_map: PointMap) -> DescriptorSet:
    n = len(point_map.keyframe_scans)
    return DescriptorSet(np.zeros((n, 2), np.float32), None, point_map.keyframe_scans, "none", "")


def merged(before: PointMap, after: PointMap, before_T_after: Float64Array) -> MergedMaps:
    return MergedMaps(before, after, before_T_after, {}, True)


def answer(method: str, maps: MergedMaps, settings: Sequence[str] = ()) -> ChangeReport:
    config = load_config(method, [*SETTINGS, *SETTINGS_OF.get(method, ()), *settings])
    mapped = [MappedSession(each, descriptors(each)) for each in (maps.before, maps.after)]
    return detect_changes(*mapped, config, merge=lambda before, after: maps)


def returns_of(report: ChangeReport) -> set[tuple[int, int]]:
    return {(int(scan), int(pixel)) for item in report.objects for scan, pixel in item.returns}


@every
def test_an_added_crate_is_found_and_a_removed_one_too(
    method: str, empty: PointMap, crated: PointMap, crated_scans: RoomScans
) -> None:
    room_T_odom = np.linalg.inv(ODOM_T_ROOM)
    added = answer(method, merged(empty, crated, room_T_odom))
    removed = answer(method, merged(crated, empty, ODOM_T_ROOM))
    truth = crated_scans.returns_on(0)
    for report, session, kind in ((added, "after", "added"), (removed, "before", "removed")):
        (item,) = report.objects
        assert (item.session, item.kind, item.region) == (session, kind, 0)
        found = returns_of(report)
        assert len(found & truth) / len(found) > 0.95
        assert len(found & truth) / len(truth) > 0.6
        assert report.regions.scores.tolist() == [len(item.points_map)]
        assert {"t_cd_s", "t_oe_s"} <= set(report.seconds)
    centres = added.regions.centres_map, transform(room_T_odom, removed.regions.centres_map)
    for centre in np.concatenate(centres):
        np.testing.assert_allclose(centre, np.mean(CRATE, axis=0), atol=0.35)


@every
def test_nothing_changed(method: str, empty: PointMap) -> None:
    again = RoomScans([], 2, odom_T_room=ODOM_T_ROOM).mapped()
    report = answer(method, merged(empty, again, np.linalg.inv(ODOM_T_ROOM)))
    assert report.regions.centres_map.shape == (0, 3)
    assert report.objects == ()
    assert report.regions.keyframe_scores.tolist() == [0.0] * len(report.keyframe_scans[0])


@every
def test_where_the_odometry_started_matters_little(method: str, empty: PointMap, crated: PointMap) -> None:
    # maps are thinned, and rays cast, in cells of the session's own odom frame: not the same to the bit
    elsewhere = yaw_pose(-1.1, (50.0, 7.0, -3.0))
    first = answer(method, merged(empty, crated, np.linalg.inv(ODOM_T_ROOM)))
    moved = RoomScans([CRATE], 3, odom_T_room=elsewhere).mapped()
    second = answer(method, merged(empty, moved, np.linalg.inv(elsewhere)))
    np.testing.assert_allclose(first.regions.centres_map, second.regions.centres_map, atol=0.15)
    one, other = returns_of(first), returns_of(second)
    assert len(one & other) / len(one | other) > 0.7


@every
def test_where_the_other_session_did_not_come_nothing_is_new(method: str, empty: PointMap, crated: PointMap) -> None:
    report = answer(method, merged(empty, crated, yaw_pose(0.0, (500.0, 0.0, 0.0))))
    assert (len(report.regions.scores), report.objects) == (0, ())


def plane(z_m: float) -> Float64Array:
    x, y = np.meshgrid(np.arange(-3, 3, 0.2), np.arange(-3, 3, 0.2))
    # py4dgeo cuts its cylinder into slabs and drops what lies exactly between two
    roughness_m = stream(1, "plane").normal(0, 0.001, x.size)
    return np.column_stack([x.ravel(), y.ravel(), z_m + roughness_m])


def placed(
    before: Float64Array, after: Float64Array, path: Float64Array, maps: MergedMaps, radius_m: float = 9.0
) -> PlacedMaps:
    radii_m = np.full(len(path), radius_m)
    return PlacedMaps(
        maps, {"before": before, "after": after}, {"before": path, "after": path}, {"before": radii_m, "after": radii_m}
    )


@needs("m3c2")
def test_m3c2_of_a_plane_that_rose_by_hand(empty: PointMap) -> None:
    turn = yaw_pose(0.4, (1.0, 2.0, 3.0))
    turn[:3, :3] = turn[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    settings = ("m3c2.depth_m=1.5", "m3c2.distance_m=0.3")

    def share(
        session: SessionName,
        rose_m: float,
        seen_from_m: float,
        moved_by: Float64Array,
        *more: str,
        radius_m: float = 9.0,
    ) -> float:
        before, after, path = (
            transform(moved_by, cloud) for cloud in (plane(0.0), plane(rose_m), np.array([[0.0, 0.0, seen_from_m]]))
        )
        maps = placed(before, after, path, merged(empty, empty, np.eye(4)), radius_m)
        other: SessionName = "before" if session == "after" else "after"
        return float(m3c2.new_mask(maps, session, other, load_config("m3c2", [*settings, *more])).mean())

    for moved_by in (np.eye(4), turn):
        assert share("after", 0.29, 2.0, moved_by) == 0.0
        assert share("after", 0.31, 2.0, moved_by) == 1.0
        assert share("after", 0.31, 2.0, moved_by, "m3c2.distance_m=0.32") == 0.0
        # the plane that was there before is hidden by the one that came, unless one looks from below
        assert share("before", 0.31, 2.0, moved_by) == 0.0
        assert share("before", 0.31, -2.0, moved_by) == 1.0
        assert share("after", 0.31, -2.0, moved_by) == 0.0
        # beyond the cylinder there is nothing to measure a distance to
        assert share("after", 1.6, 3.0, moved_by) == 0.0
    # points that nobody passed near are not asked about
    assert share("after", 0.31, 2.0, np.eye(4), radius_m=1.5) == 0.0


@needs("m3c2")
def test_m3c2_of_clouds_turned_together_is_the_same(empty: PointMap, crated: PointMap) -> None:
    turn = yaw_pose(2.0, (-30.0, 12.0, 1.0))
    config = load_config("m3c2", SETTINGS)
    maps = merged(empty, crated, np.linalg.inv(ODOM_T_ROOM))
    before, after = empty.points, transform(maps.before_T_after, crated.points)
    path = empty.odom_T_sensor[:, :3, 3]
    first = m3c2.new_mask(placed(before, after, path, maps), "after", "before", config)
    turned = placed(transform(turn, before), transform(turn, after), transform(turn, path), maps)
    second = m3c2.new_mask(turned, "after", "before", config)
    assert first.sum() > 50
    # a point on the rim of a cylinder may be in or out
    assert np.count_nonzero(first != second) <= 0.001 * len(first)


@needs("m3c2")
def test_m3c2_leaves_no_log(empty: PointMap, caplog: pytest.LogCaptureFixture) -> None:
    # whatever py4dgeo logs goes to standard output and into a file in the working folder
    with caplog.at_level(logging.DEBUG):
        answer("m3c2", merged(empty, empty, np.eye(4)))
    assert [record.name for record in caplog.records if record.name.startswith("py4dgeo")] == []


@needs("dufomap")
def test_m3c2_silences_no_warning_of_others() -> None:
    pytest.importorskip("py4dgeo")
    asked = "('ignore', None, Warning, None, 0) in warnings.filters"
    code = f"import warnings; from cdpipe.methods.m3c2 import load_py4dgeo; load_py4dgeo(); print({asked})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_dufomap_by_hand(empty: PointMap) -> None:
    """The room ends at x = 5: void in front of that wall, but not behind it, nor within the inflation of its hits."""
    x_m = np.array([0.0, 3.0, 4.45, 4.95, 5.3, 5.9])
    asked = np.column_stack([x_m, np.zeros(len(x_m)), np.full(len(x_m), 1.5)])
    sessions = merged(empty, empty, np.eye(4))
    maps, short = (placed(asked, asked, np.zeros((1, 3)), sessions, radius_m) for radius_m in (9.0, 1.0))
    directions: tuple[tuple[SessionName, SessionName], ...] = (("after", "before"), ("before", "after"))

    def is_void(session: SessionName, other: SessionName, *settings: str, maps: PlacedMaps = maps) -> list[bool]:
        given = ("dufomap.voxel_m=0.1", "dufomap.hit_inflation_m=0.2", *settings)
        return dufomap.new_mask(maps, session, other, load_config("dufomap", given)).tolist()

    for session, other in directions:
        assert is_void(session, other) == [True, True, True, False, False, False]
    assert is_void("after", "before", "dufomap.hit_inflation_m=1") == [True, True, False, False, False, False]
    assert not any(is_void("after", "before", maps=short))


@needs("dufomap")
def test_dufomap_says_nothing(empty: PointMap, capfd: pytest.CaptureFixture[str]) -> None:
    answer("dufomap", merged(empty, empty, np.eye(4)))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("method", ["dufomap", "octomap", "removert", "erasor"])
def test_a_rival_keeps_the_map_and_the_returns_of_the_scans_that_it_reads(method: str, empty: PointMap) -> None:
    kept = kept_bytes(MappedSession(empty, descriptors(empty)), load_config(method, [f"{method}.every_scan=5"]))
    n_cast = sum(int(np.diff(empty.scan_offsets)[scan]) for scan in range(0, len(empty.odom_T_sensor), 5))
    assert kept == {
        "bytes_map_before": 12.0 * len(empty.points),
        "bytes_regions_before": 12.0 * (len(empty.points) + n_cast),
    }


@needs("octomap")
def test_octomap_by_hand(empty: PointMap) -> None:
    """The room ends at x = 5: free in front of that wall, occupied at it, and unknown behind it."""
    x_m = np.array([0.55, 3.05, 4.55, 5.0, 5.55])
    points = np.column_stack([x_m, np.full(len(x_m), 0.05), np.full(len(x_m), 1.55)])
    sessions = merged(empty, empty, np.eye(4))
    maps, short = (placed(points, points, np.zeros((1, 3)), sessions, radius_m) for radius_m in (9.0, 1.0))
    away = np.array([20_000.0, 0.0, 0.0])  # beyond what 16 bits of voxels reach
    moved = replace(empty, points=empty.points + away, odom_T_sensor=make_pose(translation=away) @ empty.odom_T_sensor)
    far = placed(points + away, points + away, away[None], merged(moved, moved, np.eye(4)), 9.0)

    def is_free(session: SessionName, other: SessionName, maps: PlacedMaps = maps) -> list[bool]:
        config = load_config("octomap", ["octomap.voxel_m=0.1", "octomap.free_below=0.3", "octomap.every_scan=1"])
        return octomap.new_mask(maps, session, other, config).tolist()

    assert is_free("after", "before") == is_free("before", "after") == [True, True, True, False, False]
    assert is_free("after", "before", far) == [True, True, True, False, False]
    assert not any(is_free("after", "before", maps=short))


def test_octomap_moves_its_origin_where_the_voxels_would_not_hold_the_map(empty: PointMap) -> None:
    # voxels of 0.01 m reach 327 m to either side; the room is 10 m long
    def origin_at(away_m: float, voxel_m: float = 0.01) -> list[float]:
        poses = make_pose(translation=(away_m, 0.0, 0.0)) @ empty.odom_T_sensor
        moved = replace(empty, points=empty.points + np.array([away_m, 0.0, 0.0]), odom_T_sensor=poses)
        return near_origin(moved, voxel_m, "before").tolist()

    low, high = empty.points.min(axis=0), empty.points.max(axis=0)
    assert origin_at(300.0) == [0.0, 0.0, 0.0]
    path = empty.odom_T_sensor[:, :3, 3]
    np.testing.assert_allclose(np.array(origin_at(400.0)) - [400.0, 0.0, 0.0], (low + high) / 2, atol=0.006)
    np.testing.assert_allclose(np.array(origin_at(2000.0)) - [2000.0, 0.0, 0.0], path.mean(axis=0), atol=0.006)
    with pytest.raises(InputError, match=r"^octomap\.voxel_m = 0\.0001: the before session is 1\d m across, .* 7 m of"):
        origin_at(0.0, voxel_m=0.0001)


@needs("octomap")
@pytest.mark.parametrize(("n_scans", "free_below", "is_free"), [(2, 0.3, False), (3, 0.3, True), (2, 0.31, True)])
def test_octomap_counts_misses(n_scans: int, free_below: float, is_free: bool) -> None:
    # odds of (0.4 / 0.6) ** 2 = 0.44 are a probability of 0.308, those of the third power one of 0.229
    scanned = RoomScans([], 1, path=[(0.02, 0.02, 1.52)] * n_scans).mapped()
    points = np.array([[3.05, 0.05, 1.55]])
    maps = placed(points, points, np.zeros((1, 3)), merged(scanned, scanned, np.eye(4)))
    config = load_config("octomap", ["octomap.voxel_m=0.1", f"octomap.free_below={free_below}", "octomap.every_scan=1"])
    assert octomap.new_mask(maps, "after", "before", config).tolist() == [is_free]


@needs("m3c2-ep")
@pytest.mark.parametrize(("rose_m", "share"), [(0.13, 0.0), (0.15, 1.0)])
def test_m3c2_ep_of_a_plane_that_rose_by_hand(rose_m: float, share: float, empty: PointMap) -> None:
    # with exact ranges and angles the level is sqrt(7.815) = 2.796 standard deviations of the alignment: 0.140 m
    settings = ("m3c2_ep.alignment_m=0.05", "m3c2_ep.range_m=1e-6", "m3c2_ep.angle_deg=1e-6", "m3c2.cylinder_m=0.5")
    maps = placed(plane(0.0), plane(rose_m), np.array([[0.0, 0.0, 2.0]]), merged(empty, empty, np.eye(4)))
    config = load_config("m3c2-ep", settings)
    # corners of the planes have too few points
    is_inner = np.abs(plane(0.0)[:, :2]).max(axis=1) < 2.0
    assert m3c2_ep.new_mask(maps, "after", "before", config)[is_inner].mean() == share
    assert m3c2_ep.new_mask(maps, "before", "after", config).mean() == 0.0


def test_levels_of_detection_by_hand() -> None:
    """Points 3 m below one path and 2 m above the other: along the normal ranges err, across it angles do."""
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    n_own, n_other, unused = np.array([9, 9, 4]), np.array([6, 6, 9]), np.zeros(3)
    found = Distances(unused, unused, normals, n_own, n_other)
    settings = M3C2EPConfig(range_m=0.06, angle_deg=np.rad2deg(0.01), alignment_m=0.0)
    paths = np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, -2.0]])
    levels_m = detection_levels(np.zeros((3, 3)), *paths, found, settings)
    along_m2, across_m2 = 0.06**2 / 9 + 0.06**2 / 6, 0.03**2 / 9 + 0.02**2 / 6
    expected_m = np.sqrt(7.815 * np.array([along_m2, across_m2, np.nan]))
    np.testing.assert_allclose(levels_m, expected_m, rtol=1e-6)
    # the error of the alignment is added, and no average reduces it
    aligned = detection_levels(np.zeros((3, 3)), *paths, found, settings.model_copy(update={"alignment_m": 0.05}))
    np.testing.assert_allclose(aligned**2 - levels_m**2, 7.815 * 0.05**2 * np.array([1, 1, np.nan]), rtol=1e-6)
