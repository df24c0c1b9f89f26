"""One recording as two sessions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, make_pose
from sim.graft.splitting import split_scans


def path(*corners: tuple[float, float], step_m: float = 0.5) -> Float64Array:
    """Poses along straight lines between corners."""
    places = [np.array(corners[0])]
    for start, end in pairwise(corners):
        n = max(1, round(float(np.hypot(end[0] - start[0], end[1] - start[1])) / step_m))
        places += [np.array(start) + (np.array(end) - start) * k / n for k in range(1, n + 1)]
    return make_pose(translation=np.column_stack([np.array(places), np.zeros(len(places))]))


def test_forth_and_back_is_cut_where_it_turns() -> None:
    split = split_scans(path((0, 0), (30, 0), (0, 0.4)), "auto", "drive")
    assert split.name == "passes"
    assert abs(split.after[0] - 60) <= 4
    np.testing.assert_array_equal(np.concatenate([split.before, split.after]), np.arange(121))


def test_two_laps_are_two_passes() -> None:
    lap = [(0, 0), (20, 0), (20, 15), (0, 15)]
    split = split_scans(path(*lap, *lap, (0, 0)), "passes", "drive")
    assert abs(len(split.before) - len(split.after)) <= 8


@pytest.mark.parametrize("stands_m", [3.0, 28.0])
def test_the_scans_of_a_sensor_that_stood_are_no_way(stands_m: float) -> None:
    """Of 40 m and 12 m back 28 m are driven once, however long the sensor stood where it passed twice, or once."""
    drive = path((0, 0), (40, 0), (28, 0.4))
    stop = int(np.argmin(np.abs(drive[:, 0, 3] - (40.0 - stands_m))))
    stood = np.concatenate([drive[:stop], np.repeat(drive[stop : stop + 1], 600, axis=0), drive[stop:]])
    assert split_scans(stood, "auto", "drive").name == split_scans(drive, "auto", "drive").name == "alternate"
    there_and_back = path((0, 0), (30, 0), (4, 0.4))
    stood = np.concatenate([np.repeat(there_and_back[:1], 600, axis=0), there_and_back])
    assert abs(split_scans(stood, "auto", "drive").after[0] - 660) <= 4


def test_a_way_driven_once_gives_every_other_revolution() -> None:
    poses = path((0, 0), (30, 0))
    split = split_scans(poses, "auto", "drive")
    assert split.name == "alternate"
    np.testing.assert_array_equal(split.before, np.arange(0, 61, 2))
    np.testing.assert_array_equal(split.after, np.arange(1, 61, 2))
    halves = split_scans(poses, "halves", "drive")
    assert (halves.before[-1], halves.after[0]) == (29, 30)
    with pytest.raises(InputError, match="drive: no way is driven twice"):
        split_scans(poses, "passes", "drive")


def test_a_sensor_that_stands_gives_every_other_revolution() -> None:
    assert split_scans(np.tile(make_pose(), (7, 1, 1)), "auto", "drive").name == "alternate"
    with pytest.raises(InputError, match="one revolution"):
        split_scans(make_pose()[None], "auto", "drive")
