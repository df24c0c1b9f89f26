from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.mapping.free_space import COLUMNS, ROWS, free_space_votes, grazing_ray_count, render_view, views_of_one
from cdpipe.model.types import KeyframeViews
from tests.cdpipe.rooms import ROOM, Box, cast

MAX_ELEVATION_RAD = np.deg2rad(45.6)


def directions(elevations_deg: tuple[float, float], n: int = 200_000, seed: int = 0) -> Float64Array:
    rng = stream(seed, "directions")
    elevation, azimuth = np.deg2rad(rng.uniform(*elevations_deg, n)), rng.uniform(-np.pi, np.pi, n)
    return np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def looked_from(
    *poses: Float64Array, boxes: Sequence[Box] = (), elevations_deg: tuple[float, float] = (-44, 44)
) -> KeyframeViews:
    """What dense scans of the room from some places see."""
    images = []
    for room_T_sensor in poses:
        beams = directions(elevations_deg)
        ranges_m, _ = cast(room_T_sensor[:3, 3], beams @ room_T_sensor[:3, :3].T, boxes)
        images.append(render_view(ranges_m[:, None] * beams))
    return KeyframeViews(np.stack(images), invert(np.stack(poses)))


def pixel_of(point: Float64Array) -> tuple[int, int]:
    elevation = np.arctan2(point[2], np.hypot(point[0], point[1]))
    row = int(np.floor((MAX_ELEVATION_RAD - elevation) * ROWS / (2 * MAX_ELEVATION_RAD)))
    return row, int(np.floor(np.arctan2(point[1], point[0]) * COLUMNS / (2 * np.pi))) % COLUMNS


def seen_through(points: Float64Array, views: KeyframeViews) -> np.ndarray:
    return free_space_votes(points, views) > 0


def test_a_view_holds_the_nearest_return_of_each_pixel() -> None:
    points = stream(0, "view").uniform(-3, 3, (3000, 3))
    expected: dict[tuple[int, int], float] = {}
    for point in points:
        pixel = pixel_of(point)
        if 0 <= pixel[0] < ROWS:
            expected[pixel] = min(expected.get(pixel, np.inf), float(np.linalg.norm(point)))
    assert 1000 < len(expected) < 3000
    image = render_view(points)
    assert (image.shape, image.dtype) == ((ROWS, COLUMNS), np.float16)
    assert np.count_nonzero(image) == len(expected)
    for pixel, range_m in expected.items():
        assert image[pixel] == np.float16(np.float32(range_m))
    assert not render_view(np.zeros((0, 3))).any()
    assert not render_view(np.zeros((1, 3))).any()  # a return at the sensor itself has no direction


def test_a_room_is_free_up_to_its_walls_and_unknown_behind_them() -> None:
    room_T_sensor = yaw_pose(0.7, (0.8, -0.5, 1.4))
    views = looked_from(room_T_sensor)
    beams = directions((-42, 42), 2000, seed=1)
    ranges_m, _ = cast(room_T_sensor[:3, 3], beams @ room_T_sensor[:3, :3].T, ())

    def are_free(along_m: Float64Array) -> np.ndarray:
        return seen_through(transform(room_T_sensor, along_m[:, None] * beams), views)

    # a pixel is 1.4 degrees high: where a beam grazes the floor its neighbours come back a little earlier
    is_far = ranges_m > 1.2
    assert is_far.mean() > 0.9
    assert are_free(0.6 * ranges_m)[is_far].all()
    for behind_m in (-0.1, 0.0, 0.1, 0.5, 2.0):
        assert not are_free(ranges_m + behind_m).any()


def test_what_is_above_or_below_or_out_of_reach_was_not_looked_at() -> None:
    # in a hall without end every ray comes back from 50 m: all is free that a pixel looks at
    beams = directions((-60, 60))
    views = KeyframeViews(render_view(50.0 * beams)[None], np.eye(4)[None])
    for elevation_deg, is_free in ((44.0, True), (-44.0, True), (46.0, False), (-46.0, False), (90.0, False)):
        up = np.deg2rad(elevation_deg)
        assert seen_through(np.array([[3 * np.cos(up), 0.0, 3 * np.sin(up)]]), views).tolist() == [is_free]
    along = np.array([[x, 0.1, 0.0] for x in (0.3, 0.6, 14.9, 15.1)])
    assert seen_through(along, views).tolist() == [False, True, True, False]


def test_a_shadow_is_unknown_until_someone_looks_behind_it() -> None:
    screen = (((0.9, -1.0, 0.0), (1.1, 1.0, 3.0)),)
    front, side = make_pose(translation=(-2.0, 0.0, 1.5)), make_pose(translation=(2.0, 3.0, 1.5))
    hidden = np.array([[2.0, 0.0, 1.5], [1.6, 0.3, 1.2]])
    assert not seen_through(hidden, looked_from(front, boxes=screen)).any()
    assert seen_through(hidden, looked_from(front, side, boxes=screen)).all()
    assert seen_through(hidden, looked_from(front)).all()
    # without returns there is no telling
    assert not seen_through(hidden, looked_from(front, elevations_deg=(20, 44))).any()


def test_more_must_have_seen_through_than_hit() -> None:
    place = np.array([[2.0, 0.0, 1.5]])
    stood = (((1.9, -0.5, 0.5), (2.1, 0.5, 2.5)),)
    pose = make_pose(translation=(-1.0, 0.1, 1.5))
    empty, full = looked_from(pose), looked_from(pose, boxes=stood)
    for n_empty, n_full, is_free in ((1, 0, True), (0, 1, False), (1, 1, False), (2, 1, True), (2, 2, False)):
        images = np.concatenate([empty.ranges_m] * n_empty + [full.ranges_m] * n_full)
        views = KeyframeViews(images, np.repeat(invert(pose)[None], len(images), axis=0))
        assert seen_through(place, views).tolist() == [is_free]


@pytest.mark.parametrize("seed", range(3))
def test_looking_up_equals_its_slow_twin(seed: int) -> None:
    rng = stream(seed, "lookup")
    images = rng.uniform(0.2, 20.0, (5, ROWS, COLUMNS)).astype(np.float16)
    # smooth enough that all outcomes are common, and a third of the pixels without a return
    images = np.repeat(np.repeat(images[:, ::8, ::16], 8, axis=1), 16, axis=2)
    images[rng.random(images.shape) < 0.3] = 0
    poses = np.array([yaw_pose(rng.uniform(-3, 3), rng.uniform(-4, 4, 3)) for _ in range(5)])
    points = rng.uniform(-12, 12, (1500, 3)) * (1, 1, 0.4)
    expected = []
    for point in points:
        balance = 0
        for image, pose in zip(images, poses, strict=True):
            in_sensor = transform(invert(pose), point[None])[0]
            range_m = float(np.linalg.norm(in_sensor))
            row, column = pixel_of(in_sensor)
            if not (0 <= row < ROWS and 0.5 <= range_m <= 15.0):
                continue
            level = [float(image[row, (column + step) % COLUMNS]) for step in (0, 1, -1)]
            up, down = (
                [float(image[row + step * far, column]) if 0 <= row + step * far < ROWS else level[0] for far in (1, 2)]
                for step in (-1, 1)
            )
            # the next row with a beam, or the one after it
            above, below = (near or far for near, far in (up, down))
            seen = [each for each in (*level, above, below) if each > 0]
            is_between = level[0] == 0 and (up[0] == 0 or down[0] == 0)
            balance += bool(seen) and not is_between and min(seen) > range_m + 0.2
            balance -= any(each > 0 and abs(each - range_m) <= 0.2 for each in (*level, up[0], down[0]))
        expected.append(balance)
    found = free_space_votes(points, KeyframeViews(images, invert(poses)))
    assert 0.1 < np.mean(np.array(expected) > 0) < 0.9
    assert {-2, -1, 0, 1, 2, 3} <= set(expected)
    np.testing.assert_array_equal(found, expected)
    # places far from each other do not hide each other's keyframes
    np.testing.assert_array_equal(
        [free_space_votes(point[None], KeyframeViews(images, invert(poses)))[0] for point in points[:200]],
        expected[:200],
    )


def test_moving_the_frame_changes_nothing() -> None:
    poses = np.array([yaw_pose(0.3, (-1.0, 0.4, 1.5)), yaw_pose(-2.0, (2.0, -1.0, 1.3))])
    views = looked_from(*poses, boxes=(((0.5, 0.5, 0.0), (1.5, 1.5, 1.0)),))
    points = stream(0, "places").uniform(*ROOM, (2000, 3))
    elsewhere = yaw_pose(1.1, (300.0, -70.0, 4.0))
    moved = KeyframeViews(views.ranges_m, invert(elsewhere @ poses))
    free = seen_through(points, views)
    assert 0.1 < free.mean() < 0.9
    np.testing.assert_array_equal(seen_through(transform(elsewhere, points), moved), free)


def test_nothing_to_look_up_and_nobody_who_looked() -> None:
    views = looked_from(make_pose(translation=(0.0, 0.0, 1.5)))
    assert seen_through(np.zeros((0, 3)), views).shape == (0,)
    nobody = KeyframeViews(np.zeros((0, ROWS, COLUMNS), np.float16), np.zeros((0, 4, 4)))
    assert seen_through(np.zeros((2, 3)), nobody).tolist() == [False, False]


def test_a_ray_passes_what_stands_just_before_its_end() -> None:
    # from 1.5 m up down to the floor at x = 5 and 5.05: 0.4 m before its end the one is 0.12 m above the floor
    ends = np.array([[5.0, 0.05, 0.0], [5.05, 0.05, 0.0], [5.0, 0.05, 0.0]])
    origins = np.tile([0.0, 0.05, 1.5], (3, 1))
    places = np.array([[4.6, 0.05, 0.12], [4.6, 0.05, 0.6], [5.6, 0.05, 0.1], [3.5, 0.05, 0.45], [4.6, 0.05, -0.3]])
    # two rays of one scan are one; a metre and more before its end nobody is asked, nor under the floor
    assert grazing_ray_count(places, ends, origins, np.array([7, 7, 9])).tolist() == [2, 0, 0, 0, 0]
    assert grazing_ray_count(places[:1], ends[:0], origins[:0], np.zeros(0, np.int64)).tolist() == [0]
    hit = np.array([[5.02, 0.05, 0.0]])
    assert grazing_ray_count(hit, ends[:1], origins[:1], np.array([3])).tolist() == [-1]


@pytest.mark.parametrize("seed", range(3))
def test_rays_that_pass_equal_their_slow_twin(seed: int) -> None:
    rng = stream(seed, "rays")
    places, ends = rng.uniform(0, 0.6, (40, 3)), rng.uniform(-0.3, 0.9, (400, 3))
    origins = ends + rng.normal(0, 1, (400, 3)) * rng.choice([0.3, 4.0], (400, 1))
    scans = rng.integers(5, 12, 400)
    low = places.min(axis=0) - 0.1
    expected = []
    for place in places:
        cell = np.floor((place - low) / 0.1)
        passed, hit = set(), set()
        for end, origin, scan in zip(ends, origins, scans, strict=True):
            range_m = float(np.linalg.norm(origin - end))
            for step in range(18):
                step_m = 0.1 + 0.05 * step
                way = end + step_m / max(range_m, 0.5) * (origin - end)
                if range_m > step_m + 0.5 and (np.floor((way - low) / 0.1) == cell).all():
                    passed.add(scan)
            if (np.floor((end - low) / 0.1) == cell).all():
                hit.add(scan)
        expected.append(len(passed) - len(hit))
    assert len(set(expected)) >= 4
    np.testing.assert_array_equal(grazing_ray_count(places, ends, origins, scans), expected)


@pytest.mark.parametrize(
    ("x_m", "expected"),
    [
        ([], 1.0), ([5.0], 1.0), ([0.0, 1.0, 2.0, 3.0], 1.0), ([0.0, 6.0], 2.0), ([0.0, 10.0, 20.0], 3.0),
        ([0.0, 1.0, 2.0, 50.0], 1.0),  # one gap makes no survey
    ],
)  # fmt: skip
def test_stations_that_lie_apart_stand_for_several_views(x_m: list[float], expected: float) -> None:
    poses = np.array([make_pose(translation=(x, 0.0, 0.0)) for x in x_m]).reshape(-1, 4, 4)
    assert views_of_one(poses) == expected
