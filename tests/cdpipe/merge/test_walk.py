from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, fit_rigid, make_pose, transform
from cdpipe.merge.registration import IndexedMap, motion_between
from cdpipe.merge.walk import Step, choose_evenly, is_shared, walk
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import MappedSession

CONFIG = MergeConfig()
STEP = Step(radius_m=8.0, gicp_voxel_m=0.4, correspondence_m=3.0, first_try_m=1.0)


@pytest.fixture(scope="module")
def maps(tunnel_before: MappedSession, tunnel_after: MappedSession) -> tuple[IndexedMap, IndexedMap]:
    return IndexedMap(tunnel_before.map, CONFIG, is_target=True), IndexedMap(tunnel_after.map, CONFIG, is_target=False)


def test_a_right_start_fits_all_along(maps: tuple[IndexedMap, IndexedMap], true_before_T_after: Float64Array) -> None:
    keyframes = choose_evenly(np.arange(len(maps[1].positions)), 8, 3)
    found = walk(*maps, keyframes, 3, true_before_T_after, STEP, CONFIG)
    assert found.fits.min() > 0.9
    errors = [
        motion_between(pose, true_before_T_after, maps[1].positions[keyframe])
        for pose, keyframe in zip(found.before_T_after, keyframes, strict=True)
    ]
    # the ends of the path, where half of each sphere is missing, are found less well
    assert np.median(errors, axis=0)[0] < 0.06
    assert np.max(errors, axis=0)[0] < 0.2
    assert np.rad2deg(np.max(errors, axis=0)[1]) < 1.0
    eigenvalues = np.linalg.eigvalsh(found.information[:, 3:, 3:].sum(axis=0))
    assert eigenvalues[0] > 0.01 * eigenvalues[-1]
    assert (found.residuals_m < 0.05).all()


def test_a_start_a_few_metres_along_the_tunnel_is_found_out(
    maps: tuple[IndexedMap, IndexedMap], true_before_T_after: Float64Array
) -> None:
    wrong = make_pose(translation=(8.0, 3.0, 0.0)) @ true_before_T_after
    found = walk(*maps, choose_evenly(np.arange(len(maps[1].positions)), 8, 3), 3, wrong, STEP, CONFIG)
    assert np.nanmean(found.fits) < 0.6


def test_where_the_before_session_never_was_nothing_is_said(
    maps: tuple[IndexedMap, IndexedMap], true_before_T_after: Float64Array
) -> None:
    away = make_pose(translation=(0.0, 0.0, 400.0)) @ true_before_T_after
    found = walk(*maps, choose_evenly(np.arange(len(maps[1].positions)), 5, 0), 0, away, STEP, CONFIG)
    assert np.isnan(found.fits).all()
    assert not found.information.any()
    np.testing.assert_array_equal(found.before_T_after, np.repeat(away[None], 5, axis=0))


def test_a_registration_that_jumps_is_no_drift(
    tunnel_before: MappedSession, maps: tuple[IndexedMap, IndexedMap], true_before_T_after: Float64Array
) -> None:
    # 1.6 m off: GICP would come back, but between neighbours that are metres apart nothing drifts so far
    off = make_pose(translation=(0.0, 0.0, 1.6)) @ true_before_T_after
    found = walk(*maps, choose_evenly(np.arange(len(maps[1].positions)), 8, 3), 3, off, STEP, CONFIG)
    assert found.fits[3] == 0.0


def test_where_the_way_is_lost_it_is_looked_for_in_smaller_steps(
    tunnel_before: MappedSession,
    tunnel_after: MappedSession,
    true_before_T_after: Float64Array,
    bent: Callable[[MappedSession, float], tuple[MappedSession, Float64Array]],
) -> None:
    # the after odometry bends by 6 degrees: too much for one step from end to end, not for several
    bent_after, _ = bent(tunnel_after, np.deg2rad(6.0))
    before = IndexedMap(tunnel_before.map, CONFIG, is_target=True)
    after = IndexedMap(bent_after.map, CONFIG, is_target=False)
    ends = np.array([0, len(after.positions) - 1])
    found = walk(before, after, ends, 0, true_before_T_after, STEP, CONFIG)
    assert found.fits.min() > 0.7
    assert len(found.keyframes) > 2
    assert (np.diff(found.keyframes) > 0).all()
    assert len(found.before_T_after) == len(found.information) == len(found.fits) == len(found.keyframes)


def test_shared_is_within_five_metres_of_the_before_path(tunnel_before: MappedSession) -> None:
    poses = np.array([make_pose(translation=(x, 0, 0)) for x in (0.0, 1.0)])
    line = replace(
        tunnel_before.map, odom_T_sensor=poses, keyframe_scans=np.arange(2), scan_offsets=np.zeros(3, np.int64)
    )
    before = IndexedMap(line, CONFIG, is_target=False)
    asked = np.array([[0.5, 4.9, 0.0], [0.5, 5.1, 0.0], [5.9, 0.0, 0.0]])
    assert is_shared(before, asked).tolist() == [True, False, True]


def test_evenly_spaced_keyframes_and_one_more() -> None:
    everywhere = np.arange(11)
    assert choose_evenly(everywhere, 3, 5).tolist() == [0, 5, 10]
    assert choose_evenly(everywhere, 3, 7).tolist() == [0, 5, 7, 10]
    assert choose_evenly(everywhere[4:7], 3, 0).tolist() == [0, 4, 5, 6]
    assert choose_evenly(everywhere[:2], 10, 0).tolist() == [0, 1]


def test_one_transform_is_fitted_to_several() -> None:
    rng = np.random.default_rng(0)
    positions = np.column_stack([np.linspace(0, 50, 6), np.zeros(6), np.zeros(6)])
    same = make_pose(translation=rng.normal(size=3))
    np.testing.assert_allclose(fit_rigid(positions, np.repeat(same[None], 6, axis=0)), same, atol=1e-9)
    # a straight path that is lifted steadily: the nearest rigid motion pitches
    lifted = np.array([make_pose(translation=(0, 0, 0.01 * x)) for x in positions[:, 0]])
    found = transform(fit_rigid(positions, lifted), positions)
    assert np.abs(found[:, 2] - 0.01 * positions[:, 0]).max() < 0.03


def test_a_map_that_is_only_moved_is_no_target(tunnel_before: MappedSession) -> None:
    moved = IndexedMap(tunnel_before.map, CONFIG, is_target=False)
    with pytest.raises(ValueError, match="not indexed as a target"):
        _ = moved.target
    with pytest.raises(ValueError, match="not indexed as a target"):
        _ = moved.coarse_target
