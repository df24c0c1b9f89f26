from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, yaw_pose
from cdpipe.descriptors.sphere import anchor_frames, change_log_odds, change_logits, dequantise, describe_map
from cdpipe.descriptors.sphere_image import (
    COLUMNS,
    HALF_LENGTH_M,
    REACH_M,
    ROWS,
    GridIndex,
    pixels,
    render,
    sphere_image,
)
from cdpipe.descriptors.sphere_network import SECTORS, make_untrained_sphere_network
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import DescriptorConfig, SphereConfig, load_config
from cdpipe.model.types import DescriptorSet, MergedMaps, PointMap
from cdpipe.query.query import find_regions

N_KEYFRAMES = 24
SENSOR, PATH = SphereConfig(), SphereConfig(frames="path")


def test_pixels_by_hand() -> None:
    quarter = COLUMNS // 4
    points = np.array(
        [
            [1e-6, 2.0, 1e-6],  # to the left: just behind the middle row, first column
            [1e-6, -1e-6, 2.0],  # above: just past a quarter of the turn
            [-HALF_LENGTH_M + 1e-6, -2.0, -1e-6],  # to the right, at the back: first row, just past half the turn
            [HALF_LENGTH_M, 2.0, 0.0],  # the row beyond the last
            [0.0, REACH_M, 0.1],  # too far from the axis
        ]
    )
    expected = [ROWS // 2 * COLUMNS, ROWS // 2 * COLUMNS + quarter, 2 * quarter, -1, -1]
    assert pixels(points).tolist() == expected


def test_the_nearest_point_of_a_pixel_counts() -> None:
    image = sphere_image(np.array([[0.01, 3.0, 0.01], [0.02, 2.5, 0.01], [0.01, 0.01, -4.0]]))
    assert image[ROWS // 2, 0] == pytest.approx(np.hypot(2.5, 0.01))
    assert (image > 0).sum() == 2
    assert not sphere_image(np.zeros((0, 3))).any()


def test_a_rendered_map_is_what_its_points_are_from_each_pose() -> None:
    draw = np.random.default_rng(3)
    points = draw.uniform(-20, 20, size=(4000, 3))
    poses = np.array([yaw_pose(angle, translation=draw.uniform(-5, 5, 3)) for angle in (0.0, 0.7, -2.0)])
    images = render(GridIndex(points), poses)
    for image, pose in zip(images, poses, strict=True):
        expected: dict[int, float] = {}
        for x, y, z in transform(invert(pose), points):
            if abs(x) < HALF_LENGTH_M and np.hypot(y, z) <= REACH_M:
                row = int(np.floor((x + HALF_LENGTH_M) / (2 * HALF_LENGTH_M) * ROWS))
                column = int(np.floor(np.arctan2(z, y) / (2 * np.pi) * COLUMNS)) % COLUMNS
                key = row * COLUMNS + column
                expected[key] = min(expected.get(key, np.inf), np.hypot(y, z))
        found = {int(key): image.flat[key] for key in np.flatnonzero(image)}
        assert found == pytest.approx(expected)


def test_the_network_turns_with_the_tunnel() -> None:
    network = make_untrained_sphere_network()
    draw = torch.Generator().manual_seed(0)
    before, after = 2 + 3 * torch.rand(2, 3, ROWS, COLUMNS, generator=draw)
    turn = COLUMNS // SECTORS
    with torch.inference_mode():
        spheres = network.encode(before)
        assert spheres.shape == (3, 4, SECTORS) and spheres.abs().max() < 1
        turned = network(before.roll(5 * turn, 2), after.roll(5 * turn, 2))
        torch.testing.assert_close(turned, network(before, after).roll(5, 1), atol=1e-5, rtol=0)


def _tunnel(seed: int, block_at_m: float | None = None) -> Float64Array:
    """A rough round tunnel of 2.5 m along x, perhaps with a block of 1 m on its left side."""
    draw = np.random.default_rng(seed)
    x, angle = np.meshgrid(np.arange(-2.0, N_KEYFRAMES + 2.0, 0.12), np.arange(0, 2 * np.pi, 0.06))
    x, angle = x.ravel() + draw.normal(0, 0.01, x.size), angle.ravel()
    radius = 2.5 + 0.15 * np.sin(1.3 * x) * np.cos(3 * angle) + draw.normal(0, 0.01, x.size)
    if block_at_m is not None:
        is_block = (np.abs(x - block_at_m) < 0.5) & (np.abs(angle - 0.4) < 0.3)
        radius = np.where(is_block, radius - 1.0, radius)
    return np.column_stack([x, radius * np.cos(angle), radius * np.sin(angle)])


def _map_of(points: Float64Array, odom_T_sensor: Float64Array) -> PointMap:
    n = len(odom_T_sensor)
    nothing = np.zeros(0, np.int32)
    return PointMap(
        points, np.ones(len(points), np.float32), 0.2, odom_T_sensor, np.arange(n), nothing, nothing,
        np.zeros(n + 1, np.int64),
    )  # fmt: skip


def _set_of(thin_map: PointMap, precision: str = "float32", sphere: SphereConfig = SENSOR) -> DescriptorSet:
    n = len(thin_map.keyframe_scans)
    anchors = anchor_frames(thin_map, thin_map.keyframe_scans, sphere)
    spheres = describe_map(thin_map, anchors, DescriptorConfig(precision=precision))
    return DescriptorSet(np.ones((n, 1), np.float32), None, thin_map.keyframe_scans, "by hand", "", spheres)


def _merged(block_at_m: float | None, before_T_after: Float64Array) -> MergedMaps:
    path = np.array([make_pose(translation=(k, 0.0, 0.0)) for k in range(N_KEYFRAMES)])
    after_T_before = invert(before_T_after)
    before = _map_of(_tunnel(1), path)
    after = _map_of(transform(after_T_before, _tunnel(2, block_at_m)), after_T_before @ path)
    return MergedMaps(before, after, before_T_after, {}, True)


def test_a_new_block_is_found_where_it_stands_whatever_the_after_session_s_frame() -> None:
    covered = np.ones(N_KEYFRAMES, np.bool_)
    first: Float64Array | None = None
    for before_T_after in (make_pose(), yaw_pose(2.0, translation=(40.0, -7.0, 1.0))):
        merged = _merged(12.0, before_T_after)
        logits = change_logits(merged, _set_of(merged.before), covered)
        row, sector = np.unravel_index(np.argmax(logits), logits.shape)
        assert abs(row - 12) <= 1 and sector in (0, 1)
        far = np.abs(np.arange(N_KEYFRAMES) - 12) > 3
        assert logits[far].max() < logits.max() - 2
        first = logits if first is None else first
        np.testing.assert_allclose(logits, first, atol=0.2)  # points on a pixel's border may change sides
        # asked at the keyframes of the other session, it is the same with the sessions swapped
        swapped = MergedMaps(merged.after, merged.before, invert(before_T_after), {}, True)
        asked = change_logits(merged, _set_of(merged.after), covered, session="after")
        np.testing.assert_allclose(asked, change_logits(swapped, _set_of(merged.after), covered), atol=1e-4)
        assert abs(asked.max(axis=1).argmax() - 12) <= 1


def test_eight_bits_say_about_the_same() -> None:
    merged = _merged(12.0, make_pose())
    covered = np.ones(N_KEYFRAMES, np.bool_)
    fine, coarse = _set_of(merged.before), _set_of(merged.before, "int8")
    assert coarse.spheres is not None and fine.spheres is not None
    assert coarse.spheres.dtype == np.int8 and coarse.spheres.nbytes * 4 == fine.spheres.nbytes
    np.testing.assert_allclose(dequantise(coarse.spheres), fine.spheres, atol=0.5 / 127 + 1e-6)
    np.testing.assert_allclose(change_logits(merged, coarse, covered), change_logits(merged, fine, covered), atol=0.5)


def test_regions_of_spheres_and_the_reach_of_their_scores() -> None:
    merged = _merged(12.0, make_pose())
    before, after = _set_of(merged.before), _set_of(merged.after)
    regions = find_regions(merged, before, after, load_config("tunnelcd", ["query.radius_m=4"]))
    assert abs(regions.centres_map[0, 0] - 12) <= 1
    assert regions.pairs[0].tolist() == [round(regions.centres_map[0, 0])] * 2
    assert not regions.direction.any()  # it is always the before keyframe that is looked up
    best = int(regions.pairs[0, 0])
    # a score reaches 4 m, and falls on the way; keyframes are a metre apart
    local = np.minimum(change_log_odds(merged, before, np.ones(N_KEYFRAMES, np.bool_)), 3.0)
    away_m = np.abs(np.arange(N_KEYFRAMES)[:, None] - np.arange(N_KEYFRAMES))
    reached = np.where(away_m <= 4, local - 0.1 * away_m, -np.inf).max(axis=1)
    np.testing.assert_allclose(regions.keyframe_scores, reached, atol=1e-9)
    assert regions.keyframe_scores[best] == min(regions.scores[0], 3.0) == reached.max()


def test_keyframes_the_after_session_never_came_near_have_no_score() -> None:
    merged = _merged(None, make_pose())
    before, after = _set_of(merged.before), _set_of(merged.after)
    short = replace(after, q=after.q[:8], keyframe_scans=after.keyframe_scans[:8], spheres=None)
    regions = find_regions(merged, before, short, load_config("tunnelcd", ["query.max_pair_m=2"]))
    assert np.isfinite(regions.keyframe_scores[:10]).all() and np.isnan(regions.keyframe_scores[10:]).all()
    assert regions.centres_map[:, 0].max() <= 9


def test_without_sphere_descriptors_it_says_what_is_missing() -> None:
    merged = _merged(None, make_pose())
    without = replace(_set_of(merged.before), spheres=None)
    with pytest.raises(ValueError, match="describe its map"):
        change_logits(merged, without, np.ones(N_KEYFRAMES, np.bool_))


def test_a_bent_alignment_is_followed_keyframe_by_keyframe() -> None:
    merged = _merged(12.0, make_pose())
    # the after session's frame slides by 2 cm a metre: a rigid merge would be half a metre off at the end
    slides = np.array([make_pose(translation=(0.02 * k, 0.0, 0.0)) for k in range(N_KEYFRAMES)])
    anchors = merged.after.odom_T_sensor[:, :3, 3]
    bent = PathAlignment(anchors, slides)
    points = merged.after.points.copy()
    points[:, 0] /= 1.02
    after = replace(merged.after, points=points)
    logits = change_logits(
        replace(merged, after=after, local=bent), _set_of(merged.before), np.ones(N_KEYFRAMES, np.bool_)
    )
    assert abs(int(np.argmax(logits.max(axis=1))) - 12) <= 1


@pytest.mark.parametrize("turn_deg", [(90, 0, 0), (180, 20, 0), (0, -15, 10), None])
def test_rolling_pitching_and_turning_the_sensor_changes_nothing(turn_deg: tuple[int, ...] | None) -> None:
    level = _merged(12.0, make_pose())
    turns = (
        Rotation.random(N_KEYFRAMES, random_state=0)
        if turn_deg is None
        else Rotation.from_euler("ZYX", np.tile(turn_deg, (N_KEYFRAMES, 1)), degrees=True)
    )
    before = replace(
        level.before,
        odom_T_sensor=level.before.odom_T_sensor @ make_pose(turns.as_matrix(), np.zeros((N_KEYFRAMES, 3))),
    )
    descriptors, of_level = _set_of(before, sphere=PATH), _set_of(level.before, sphere=PATH)
    np.testing.assert_allclose(dequantise(descriptors.spheres), dequantise(of_level.spheres), atol=1e-5)
    covered = np.ones(N_KEYFRAMES, np.bool_)
    logits = change_logits(replace(level, before=before), descriptors, covered, PATH)
    np.testing.assert_allclose(logits, change_logits(level, of_level, covered, PATH), atol=1e-3)
    # on the sensor's own axes it is another image
    on_its_axes = _set_of(before), _set_of(level.before)
    assert np.abs(dequantise(on_its_axes[0].spheres) - dequantise(on_its_axes[1].spheres)).max() > 0.1
