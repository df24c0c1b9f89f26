from __future__ import annotations

import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, InputWarning, MergeFailedError
from cdpipe.core.geometry import Float64Array, stream, yaw_pose
from cdpipe.io.answer import read_answer, write_answer
from cdpipe.io.readers import open_session
from cdpipe.methods.registry import Method
from cdpipe.model.config import ClusterConfig, ExtractConfig, MergeConfig, OutlierConfig, PipelineConfig, QueryConfig
from cdpipe.model.report import ChangeReport, SurfaceField
from cdpipe.model.types import MappedSession
from cdpipe.pipeline import detect_changes, map_session
from cdpipe.pipeline.detection import _warn_of_no_level

CONFIG = PipelineConfig(
    merge=MergeConfig(voxel_m=0.25),
    query=QueryConfig(reading="paired", n_regions=40, radius_m=4.5),
    extract=ExtractConfig(method="voxel", voxel_m=0.3),
    outlier=OutlierConfig(sigmas=2.0),
    cluster=ClusterConfig(min_points=20),
)


BY_SURFACE = CONFIG.model_copy(update={"extract": ExtractConfig()})


@pytest.fixture(scope="module", params=[CONFIG, BY_SURFACE], ids=["voxel", "surface"])
def report(request: pytest.FixtureRequest, tunnel_before: MappedSession, tunnel_after: MappedSession) -> ChangeReport:
    return detect_changes(tunnel_before, tunnel_after, request.param)


def test_the_three_boxes_are_found(report: ChangeReport, box_centres_map: dict[str, Float64Array]) -> None:
    found = {
        (item.session, item.kind, name)
        for item in report.objects
        for name, centre in box_centres_map.items()
        if np.linalg.norm(item.points_map.mean(axis=0) - centre) < 0.4
    }
    assert found == {("after", "added", "added"), ("before", "moved", "moved_from"), ("after", "moved", "moved_to")}
    moved = {item.session: item for item in report.objects if item.kind == "moved"}
    assert report.objects[moved["before"].partner] is moved["after"]
    assert report.objects[moved["after"].partner] is moved["before"]


def test_the_report_names_its_settings_and_times(report: ChangeReport, tunnel_after: MappedSession) -> None:
    assert set(report.seconds) == {
        "t_index_s", "t_merge_s", "t_refine_s", "t_cd_s", "t_oe_s", "t_returns_s",
    }  # fmt: skip
    assert report.seconds["t_returns_s"] < report.seconds["t_oe_s"]
    assert all(value > 0 for value in report.seconds.values())
    assert report.config in (CONFIG.model_dump(), BY_SURFACE.model_dump())
    assert report.evidence["inlier_share"] > 0.9
    np.testing.assert_array_equal(report.keyframe_scans[1], tunnel_after.map.keyframe_scans)
    for item in report.objects:
        assert item.returns[:, 0].max() < len(tunnel_after.map.odom_T_sensor)
        assert len(item.returns) >= len(item.points_map)
        assert len({tuple(row) for row in item.returns.tolist()}) == len(item.returns)


def test_a_source_that_returns_something_else_is_named(
    tunnel_before: MappedSession, tunnel_after: MappedSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind, method in (
        ("ChangeReport", Method(lambda *_: None, None, uses_descriptors=False, has_clusters=False)),
        ("ChangeRegions", Method(None, lambda *_: None, uses_descriptors=False, has_clusters=False)),
    ):
        monkeypatch.setattr("cdpipe.pipeline.detection.load_source", lambda _, method=method: method)
        with pytest.raises(InputError, match=f"^regions.source = scan returned NoneType: expected {kind}$"):
            detect_changes(tunnel_before, tunnel_after, CONFIG)


def test_the_report_survives_the_disk(report: ChangeReport, tmp_path: Path) -> None:
    write_answer(tmp_path, "test", report)
    stored = read_answer(tmp_path).report
    assert stored is not None
    assert [item.kind for item in stored.objects] == [item.kind for item in report.objects]
    np.testing.assert_array_equal(stored.figures["v_sphere_m3"], report.figures["v_sphere_m3"])


def test_displacement_without_a_level_is_warned_of() -> None:
    def field(*levels_m: float) -> SurfaceField:
        n = len(levels_m)
        none, region = np.zeros((n, 3)), np.full(n, -1, np.int32)
        return SurfaceField(none, none, np.full(n, 0.01), np.array(levels_m, dtype=np.float64), region)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for surface in (None, field(), field(np.nan, 0.01)):
            _warn_of_no_level(surface, "planes")
    with pytest.warns(InputWarning, match="no displacement has a level of detection.*m3c2-ep"):
        _warn_of_no_level(field(np.nan, np.nan), "planes")


def test_sessions_without_overlap_fail_with_evidence(tunnel_before: MappedSession, other_tunnel: MappedSession) -> None:
    with pytest.raises(MergeFailedError, match=r"the sessions cannot be merged: only .* may not overlap") as caught:
        detect_changes(tunnel_before, other_tunnel, CONFIG)
    assert caught.value.evidence["inlier_share"] < 0.9


def test_a_folder_of_ply_scans_is_mapped(tmp_path: Path) -> None:
    rng = stream(0, "ply run")
    lines = []
    for index in range(4):
        pose = yaw_pose(0.1 * index, (0.7 * index, 0.0, 1.0))
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(" ".join(str(value) for value in (0.1 * index, *pose[:3, 3], *quaternion)))
        points = rng.uniform(-5, 5, (2000, 3)) * (1, 1, 0.2)
        meshio.ply.write(tmp_path / f"{index}.ply", meshio.Mesh(points, []))
    (tmp_path / "poses.tum").write_text("\n".join(lines))
    config = PipelineConfig.model_validate({"descriptor": {"method": "untrained"}})
    session = map_session(open_session(tmp_path), config)
    assert session.map.keyframe_scans.tolist() == [0, 2]
    assert session.descriptors.q.shape == (2, 64)
    assert len(session.map.return_points) == 8000


def test_a_single_scan_is_one_keyframe(tmp_path: Path) -> None:
    meshio.ply.write(tmp_path / "0.ply", meshio.Mesh(stream(0, "one").normal(size=(50, 3)), []))
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    session = map_session(open_session(tmp_path), PipelineConfig())
    assert session.map.keyframe_scans.tolist() == session.descriptors.keyframe_scans.tolist() == [0]


def test_two_sessions_of_few_points_are_refused_and_not_a_crash(tmp_path: Path) -> None:
    sessions = []
    for name, n_points in (("one", 1), ("few", 50)):
        folder = tmp_path / name
        folder.mkdir()
        for index in range(2):
            cloud = stream(index, name).normal((0, 2, 0), size=(n_points, 3))
            meshio.ply.write(folder / f"{index}.ply", meshio.Mesh(cloud, []))
        (folder / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 1.5 0 0 0 0 0 1\n")
        config = PipelineConfig.model_validate({"descriptor": {"method": "untrained"}})
        sessions.append(map_session(open_session(folder), config))
    with pytest.raises(MergeFailedError, match="enough points"):
        detect_changes(sessions[0], sessions[1], PipelineConfig())
