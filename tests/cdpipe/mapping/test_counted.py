"""Progress of reading and of registering, scan by scan."""

import numpy as np

from cdpipe.core.geometry import make_pose
from cdpipe.mapping.counted import CountedScans
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import MapConfig
from tests.cdpipe.conftest import CloudScans, scanned
from tests.cdpipe.mapping.poses.test_consistency import replaced

Steps = list[tuple[str, int, int]]


def short_tunnel() -> CloudScans:
    whole = scanned("drive", make_pose(), 0, 1, [])
    return replaced(whole, whole.odom_T_sensor[:6])


def test_every_scan_of_every_pass_is_told_and_the_scans_are_the_same() -> None:
    steps: Steps = []
    source = short_tunnel()
    counted = CountedScans(source, lambda *step: steps.append(step))
    for number in (1, 2):
        steps.clear()
        read = list(counted.scans())
        assert steps == [(f"pass {number}", done, 6) for done in range(7)]
        assert [scan.index for scan in read] == list(range(6))
    np.testing.assert_array_equal(read[3].points_sensor, source.scan(3).points_sensor)


def test_the_map_of_a_counted_session_is_the_same_and_registrations_are_told() -> None:
    config = MapConfig(consistency="scan-to-map")
    steps: Steps = []
    source = short_tunnel()
    found = build_map(source, config, on_step=lambda *step: steps.append(step))
    np.testing.assert_array_equal(found.points, build_map(source, config).points)
    first = [step for step in steps if step[0] == "registration 1"]
    assert first == [("registration 1", done, 6) for done in range(1, 7)]
    assert all(done <= total == 6 for _, done, total in steps)
