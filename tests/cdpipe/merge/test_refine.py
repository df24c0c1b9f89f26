from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, make_pose
from cdpipe.io import open_session
from cdpipe.io.ouster.captures import open_recording
from cdpipe.io.ouster.recording import import_recording
from cdpipe.mapping import build_map
from cdpipe.merge.held_out import choose_alignment
from cdpipe.merge.merge import merge_maps
from cdpipe.merge.pose_graph import PoseGraph, solve_pose_graph
from cdpipe.merge.refine import _discount_normal_noise, refine
from cdpipe.merge.registration import IndexedMap
from cdpipe.merge.walk import Walk, walk
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import MapConfig, MergeConfig
from cdpipe.model.types import MappedSession, PointMap
from tests.cdpipe.conftest import CloudScans


@pytest.mark.parametrize("mode", ["local", "checked"])
@pytest.mark.parametrize("scales", [(1.005, 0.995), (0.995, 1.005), (1.0, 1.0)])
def test_maps_that_stretch_differently_are_aligned_where_the_robot_stood(
    looking_ahead: Callable[[int, float], MappedSession], scales: tuple[float, float], mode: str
) -> None:
    # a sensor that looks ahead puts every face where the odometry stood some metres before it
    before, after = (looking_ahead(sample, scale) for sample, scale in enumerate(scales, 1))
    merged = merge_maps(before, after, MergeConfig(fallback=False, refine=mode))
    assert merged.is_accepted
    assert merged.local is not None
    path = after.map.odom_T_keyframe[:, :3, 3]
    errors_m = np.linalg.norm(merged.local.to_map(path) - path * scales[0] / scales[1], axis=1)
    assert np.median(errors_m) < 0.01
    assert np.percentile(errors_m, 95) < 0.02


def test_a_smooth_wall_holds_nothing_along_itself() -> None:
    # 300 normals across x, each off by some degrees: what they seem to hold along x is their noise
    rng = np.random.default_rng(0)
    normals = np.column_stack([rng.normal(0, 0.08, 300), np.repeat(np.eye(3)[1:, 1:], 150, axis=0)])
    jacobian = np.hstack([np.cross(rng.uniform(-4, 4, (300, 3)), normals), normals])
    information = jacobian.T @ jacobian
    held = _discount_normal_noise(information[None])[0]
    assert information[3, 3] > 1.5
    assert np.linalg.eigvalsh(held[3:, 3:])[0] == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.eigvalsh(held)[0] > -1e-6
    np.testing.assert_allclose(np.diag(held)[4:], np.diag(information)[4:], rtol=0.05)
    np.testing.assert_array_equal(held[:3, :3], information[:3, :3])


def wide_drift(sample: int) -> PointMap:
    """A drift 10.6 m wide flown along its middle: floor and roof are even, only the walls tell the way along."""
    rng = np.random.default_rng(sample)
    along, across = rng.uniform(0, 60, 60_000), rng.uniform(-5.3, 5.3, 60_000)
    floor, roof, left, right = np.arange(60_000).reshape(4, -1)
    up = rng.uniform(-2.5, 3.5, 60_000)
    up[floor], up[roof] = -2.5, 3.5
    rough_m = 0.2 * np.sin(1.3 * along + np.sin(up)) + 0.15 * np.sin(2.9 * along) * np.cos(up)
    across[left], across[right] = (5.3 + rough_m)[left], (-5.3 + rough_m)[right]
    points = np.column_stack([along, across, up])
    poses = np.array([make_pose(translation=(x, 0, 0)) for x in np.arange(5.0, 55.5, 0.5)])
    nearest_m, _ = cKDTree(poses[:, :3, 3]).query(points)
    none = np.zeros(0, np.int32)
    offsets = np.zeros(len(poses) + 1, np.int64)
    return PointMap(
        points, np.asarray(nearest_m, np.float32), 0.1, poses, np.arange(0, len(poses), 2), none, none, offsets
    )


def refine_wide_drift(mode: str, off_m: float) -> tuple[PathAlignment | None, dict[str, float], Float64Array]:
    """Refine two samples of the wide drift from an alignment that is off along it; also return the after path."""
    before, after = (wide_drift(sample) for sample in (1, 2))
    rigid = make_pose(translation=(off_m, 0, 0))
    found = Walk(
        np.array([10, 25, 40]), np.repeat(rigid[None], 3, axis=0), np.zeros((3, 6, 6)), np.ones(3), np.zeros(3)
    )
    alignment, evidence = refine(before, after, found, rigid, MergeConfig(fallback=False, refine=mode))
    return alignment, evidence, after.odom_T_keyframe[:, :3, 3]


@pytest.mark.parametrize("mode", ["local", "checked"])
def test_the_walls_of_a_wide_drift_are_looked_at(mode: str) -> None:
    alignment, evidence, path = refine_wide_drift(mode, off_m=0.15)
    assert alignment is not None
    assert evidence["n_refined"] > 8
    assert np.linalg.norm(alignment.to_map(path) - path, axis=1).max() < 0.01
    if mode == "checked":
        assert evidence["n_kept"] == evidence["n_judged"] == evidence["n_refined"]
        assert evidence["refined_misfit"] < evidence["rigid_misfit"]
    else:
        assert "n_judged" not in evidence


@pytest.mark.parametrize("mode", ["local", "checked"])
def test_a_refinement_that_fits_worse_is_taken_back(monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    def solve_wrongly(positions: Float64Array, registered: Float64Array, *others: Float64Array) -> PoseGraph:
        return solve_pose_graph(positions, make_pose(translation=(0.4, 0, 0)) @ registered, *others)

    monkeypatch.setattr("cdpipe.merge.refine.solve_pose_graph", solve_wrongly)
    alignment, evidence, path = refine_wide_drift(mode, off_m=0.02)
    if mode == "checked":
        assert alignment is None
        assert evidence["n_kept"] == 0 and evidence["rigid_misfit"] < evidence["refined_misfit"]
    else:
        assert alignment is not None and np.linalg.norm(alignment.to_map(path) - path, axis=1).min() > 0.3


def test_points_that_are_held_out_are_not_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Float64Array] = {}

    def note(before: IndexedMap, after: IndexedMap, *others: object) -> Walk:
        seen["registered"] = after.points
        return walk(before, after, *others)

    def choose(before: IndexedMap, held_out: Float64Array, *others: object) -> tuple[Float64Array | None, dict]:
        seen["judging"] = held_out
        return choose_alignment(before, held_out, *others)

    monkeypatch.setattr("cdpipe.merge.refine.walk", note)
    monkeypatch.setattr("cdpipe.merge.refine.choose_alignment", choose)
    refine_wide_drift("checked", off_m=0.02)
    both = np.concatenate([seen["registered"], seen["judging"]])
    assert len(np.unique(both, axis=0)) == len(both)
    assert len(seen["judging"]) == pytest.approx(len(both) / 5, rel=0.02)


def test_sparse_scans_of_a_standing_sensor_are_not_pulled_apart(tmp_path: Path) -> None:
    if "TUNNELCD_REAL_DATA" not in os.environ:
        pytest.skip("TUNNELCD_REAL_DATA is unset: the real recording is not at hand")
    pytest.importorskip("ouster.sdk")
    recording = Path(os.environ["TUNNELCD_REAL_DATA"]) / "ouster" / "osf_fw_3.2_10scans.osf"
    stamps_ns = np.concatenate([each.column_stamps_ns for each in open_recording(recording).revolutions()])
    times_s = np.arange(stamps_ns.min() / 1e9 - 0.2, stamps_ns.max() / 1e9 + 0.2, 0.05)
    (tmp_path / "standing.tum").write_text("".join(f"{time_s:.9f} 0 0 0 0 0 0 1\n" for time_s in times_s))
    import_recording(recording, tmp_path / "standing", trajectory=tmp_path / "standing.tum")
    scans = list(open_session(tmp_path / "standing").scans())
    before, after = (
        build_map(CloudScans("standing", np.repeat(np.eye(4)[None], 5, axis=0), clouds), MapConfig())
        for clouds in ([scan.points_sensor for scan in scans[first::2]] for first in (0, 1))
    )
    found = Walk(np.zeros(1, np.int64), np.eye(4)[None], np.zeros((1, 6, 6)), np.ones(1), np.zeros(1))
    off_m = {}
    for mode in ("local", "checked"):
        alignment, _ = refine(before, after, found, np.eye(4), MergeConfig(refine=mode))
        off_m[mode] = 0.0 if alignment is None else float(np.linalg.norm(alignment.to_map(np.zeros((1, 3)))))
    # 8 beams, walls 7 m away: voxels of 0.8 m lose the alignment that voxels of 0.2 m keep
    assert off_m["checked"] < 0.006 < 0.01 < off_m["local"]
