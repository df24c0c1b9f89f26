from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.merge.global_registration import register_globally

needs_kiss_matcher = pytest.mark.skipif(
    importlib.util.find_spec("kiss_matcher") is None, reason="needs the extra `kiss`: KISS-Matcher"
)
BEFORE_T_AFTER = yaw_pose(2.3, (310.0, -120.0, 4.0))
VOXEL_M = 0.6


def drift(sample: int, first_m: float, last_m: float) -> Float64Array:
    """Points of a bent drift with rough walls, between two marks on its way; samples differ in where points fall."""
    rng = stream(sample, "drift")
    n = int(600 * (last_m - first_m))
    along, around = rng.uniform(first_m, last_m, n), rng.uniform(0, 2 * np.pi, n)
    phases = stream(0, "rock").uniform(0, 2 * np.pi, (12, 2))
    radius_m = 2.2 + sum(
        0.12 * np.sin((0.5 + 0.17 * k) * along + a) * np.sin((1 + k % 4) * around + b)
        for k, (a, b) in enumerate(phases)
    )
    across, up = radius_m * np.cos(around), np.maximum(radius_m * np.sin(around), -1.2)
    return np.column_stack([along, 6.0 * np.sin(along / 15.0) + across, up])


@needs_kiss_matcher
def test_two_sessions_that_share_half_their_way_are_found() -> None:
    before = drift(1, 0.0, 60.0)
    after = transform(invert(BEFORE_T_AFTER), drift(2, 30.0, 90.0))
    found = register_globally(before, after, VOXEL_M)
    assert found is not None
    shared = drift(3, 30.0, 60.0)
    missed_m = np.linalg.norm(transform(found @ invert(BEFORE_T_AFTER), shared) - shared, axis=1)
    assert missed_m.max() < 0.3
    turn = found[:3, :3] @ BEFORE_T_AFTER[:3, :3].T
    assert np.rad2deg(Rotation.from_matrix(turn[:3, :3]).magnitude()) < 2.0


@needs_kiss_matcher
def test_the_same_clouds_give_the_same_bits_on_one_thread() -> None:
    # In a process of its own: what else was imported here may have asked for threads. Several runs, because the threads
    # of the library collide by chance.
    program = """
        import os
        from cdpipe.merge.global_registration import register_globally
        from test_global_registration import drift
        before, after = drift(1, 0.0, 20.0), drift(2, 0.0, 20.0)
        processors = os.sched_getaffinity(0)
        n_threads = len(os.listdir("/proc/self/task"))
        found = [register_globally(before, after, 0.4) for _ in range(3)]
        assert len({pose.tobytes() for pose in found}) == 1
        assert len(os.listdir("/proc/self/task")) == n_threads
        assert os.sched_getaffinity(0) == processors
    """
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("threads are bounded by the processors of the process, which only Linux tells")
    here = str(Path(__file__).parent)
    environment = {**os.environ, "OMP_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join([str(Path.cwd()), here])}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], check=False, env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def scattered(n: int, sizes_m: tuple[float, float, float]) -> Float64Array:
    return stream(n, "scattered").uniform(-0.5, 0.5, (n, 3)) * sizes_m


@needs_kiss_matcher
@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        scattered(10, (9.0, 9.0, 9.0)),
        np.ones((5000, 3)),
        scattered(3000, (1000.0, 1000.0, 1000.0)),
        scattered(2000, (200.0, 0.0, 0.0)),
    ],
    ids=["empty", "one", "ten", "the same point", "no neighbours", "a line"],
)
def test_clouds_without_surfaces_are_not_found(points: Float64Array) -> None:
    # all but the repeated point end the process where they reach the library
    tunnel = drift(1, 0.0, 20.0)
    assert register_globally(points, points, VOXEL_M) is None
    assert register_globally(points, tunnel, VOXEL_M) is None
    assert register_globally(tunnel, points, VOXEL_M) is None


@needs_kiss_matcher
def test_two_planes_have_surfaces_and_no_pose() -> None:
    assert register_globally(scattered(9000, (40.0, 40.0, 0.0)), scattered(8000, (40.0, 40.0, 0.0)), VOXEL_M) is None


@needs_kiss_matcher
def test_a_cloud_fits_itself_wherever_it_lies() -> None:
    tunnel = drift(1, 0.0, 30.0)
    far = make_pose(translation=(2e6, -1e6, 300.0))
    found = register_globally(transform(far, tunnel), tunnel, VOXEL_M)
    assert found is not None
    np.testing.assert_allclose(transform(found, tunnel), transform(far, tunnel), atol=0.01)


@needs_kiss_matcher
def test_a_coarse_voxel_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    register_globally(drift(1, 0.0, 60.0), drift(2, 0.0, 60.0), 1.5)
    assert capfd.readouterr() == ("", "")


@needs_kiss_matcher
def test_wrong_points_are_named() -> None:
    tunnel = drift(1, 0.0, 20.0)
    broken = tunnel.copy()
    broken[7, 1] = np.nan
    with pytest.raises(ValueError, match="before_points"):
        register_globally(broken, tunnel, VOXEL_M)
    with pytest.raises(ValueError, match="after_points"):
        register_globally(tunnel, np.full((3, 3), np.inf), VOXEL_M)
    with pytest.raises(ValueError, match="after_points"):
        register_globally(tunnel, tunnel * 1e6, VOXEL_M)
    with pytest.raises(ValueError, match="before_points"):
        register_globally(tunnel[:, :2], tunnel, VOXEL_M)


def test_without_the_extra_the_way_out_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'tunnelcd\[kiss\]'"):
        register_globally(np.zeros((0, 3)), np.zeros((0, 3)), VOXEL_M)
