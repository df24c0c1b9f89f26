import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, yaw_pose
from cdpipe.model.types import DescriptorSet
from eval.studies.descriptors.rows import find_places, score_places

SIZE = 64
BIN_RAD = 2 * np.pi / SIZE


def poses(xs: list[float], yaws_rad: list[float]) -> Float64Array:
    return np.array([yaw_pose(yaw, (x, 0.0, 1.0)) for x, yaw in zip(xs, yaws_rad, strict=True)])


def described(q: list[list[float]], headings_rad: list[float] | None) -> DescriptorSet:
    """Orientation vectors that see one light far along the world's x axis."""
    w = None
    if headings_rad is not None:
        azimuths = (np.arange(SIZE) + 0.5) * BIN_RAD
        seen = np.exp(4 * np.cos(azimuths[None] + np.array(headings_rad)[:, None]))
        w = (seen - seen.mean(axis=1, keepdims=True)).astype(np.float32)
    return DescriptorSet(np.array(q, np.float32), w, np.arange(len(q)), "by hand", "")


BEFORE = poses([0, 10, 20, 30], [0, 0, 0, 0])
UNITS = np.eye(4).tolist()


def test_scores_by_hand() -> None:
    # asked are those at 12.9, 1 and 20 m, not that at 26 m; found: place 3 (a miss by 17.1 m), place 0, place 2
    after = poses([12.9, 1, 20, 26], [-2.0, 0.5, 3.0, 0.0])
    # the first believes to look 0.3 rad farther left, the third the other way round
    headings = [0.1, 0.7, -1.0, 2.0]
    before = poses([0, 10, 20, 30], headings)
    sets = described(UNITS, headings), described([UNITS[3], UNITS[0], UNITS[2], UNITS[1]], [-1.7, 0.5, 3.0 - np.pi, 0])
    found_m, yaw_error_deg = find_places(*sets, before, after)
    np.testing.assert_allclose(found_m, [17.1, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(yaw_error_deg, [np.rad2deg(0.3), 0.0, 180.0], atol=0.2)
    scores = score_places(*sets, before, after)
    assert scores["place_recall_at_1"] == pytest.approx(2 / 3)
    assert scores["yaw_error_deg"] == pytest.approx(np.rad2deg(0.3), abs=0.2)
    assert (scores["yaw_flip_share"], scores["n_places"], scores["n_yaws"]) == (pytest.approx(1 / 3), 3.0, 3.0)


def test_a_found_place_within_three_metres_counts() -> None:
    before, after = poses([0, 2.9, 9], [0, 0, 0]), poses([0], [0])
    nearest_is_second = described([[1, 0], [0, 1], [1, 1]], None), described([[0, 1]], None)
    assert score_places(*nearest_is_second, before, after)["place_recall_at_1"] == 1.0
    before = poses([0, 3.1, 9], [0, 0, 0])
    assert score_places(*nearest_is_second, before, after)["place_recall_at_1"] == 0.0


def test_without_orientation_or_without_places() -> None:
    blind = score_places(described(UNITS, None), described(UNITS, None), BEFORE, BEFORE)
    assert (blind["place_recall_at_1"], blind["n_yaws"]) == (1.0, 0.0)
    assert np.isnan(blind["yaw_error_deg"])
    assert np.isnan(blind["yaw_flip_share"])
    far = score_places(described(UNITS, None), described([UNITS[0]], None), BEFORE, poses([500], [0]))
    assert far["n_places"] == 0.0
    assert np.isnan(far["place_recall_at_1"])
    nothing = DescriptorSet(np.zeros((0, 4), np.float32), None, np.zeros(0, np.int64), "none", "")
    assert score_places(nothing, nothing, np.zeros((0, 4, 4)), np.zeros((0, 4, 4)))["n_places"] == 0.0
    # even vectors have no peak: no yaw, and no error in it
    even = described(UNITS, None)
    even = DescriptorSet(even.q, np.zeros((4, SIZE), np.float32), even.keyframe_scans, "even", "")
    assert score_places(even, even, BEFORE, BEFORE)["n_yaws"] == 0.0


def test_turning_the_world_changes_nothing() -> None:
    headings = [0.1, -0.7, 2.0, 3.1]
    sets = described(UNITS, [0.0] * 4), described(UNITS, [0.2, -0.7, 1.5, 0.0])
    after = poses([0, 10, 20, 30], headings)
    turn = yaw_pose(2.2, (5.0, -3.0, 1.0))
    here, there = find_places(*sets, BEFORE, after), find_places(*sets, turn @ BEFORE, turn @ after)
    np.testing.assert_allclose(here[1], there[1], atol=1e-6)
    np.testing.assert_allclose(here[0], there[0], atol=1e-9)


def test_descriptors_of_other_keyframes_are_refused() -> None:
    with pytest.raises(ValueError, match="4 and 3 poses"):
        find_places(described(UNITS, None), described(UNITS, None), BEFORE, BEFORE[:3])
