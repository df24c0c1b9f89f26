from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cdpipe.core.progress import report_nothing
from cdpipe.io.session import read_session
from sim.geometry.raycast import Caster, model_meshes
from sim.props.shapes import solid_mesh
from sim.scene import compile_model
from sim.sensor.air import AIR
from sim.session.simulate import write_session
from sim.session.truth import read_labels
from sim.studies import bench
from sim.studies.bench import BenchSite, crowd, dusty_drive, mujoco_hits, sensor_contests, spread_drive, time_session
from sim.studies.timing import Contest, SkippedContest


@pytest.fixture(scope="module")
def site() -> BenchSite:
    return BenchSite(scenario="smoke/one_box", seed=0, n_props=12, repeats=2, spread_spacing_m=12.0)


def test_every_row_has_its_rival_and_its_target(site: BenchSite) -> None:
    named = sensor_contests(site)
    found = {name: contest() for name, contest in named.items() if not name.startswith("session")}
    assert {name: contest.target for name, contest in found.items()} == {
        "world": None,
        "casting": 6.0,
        "casting-12-props": 20.0,
        "casting-bare": pytest.approx(1 / 1.2),
        "casting-two-threads": 1.7,
    }
    assert named.keys() - found.keys() == {
        "session", "session-dust-dual", "session-19-sub-rays", "session-19-sub-rays-gpu",
    }  # fmt: skip
    n_mrays = site.sensor.width * site.sensor.height / 1e6
    for name, contest in found.items():
        if name == "world":
            assert (contest.unit, contest.work, contest.rival, len(contest.seconds)) == ("s", None, None, 1)
            continue
        assert contest.unit == "Mray/s"
        assert contest.work == pytest.approx((32 if name == "casting-two-threads" else 1) * n_mrays)
        assert len(contest.seconds) == len(contest.rival_seconds) >= 2
        assert min(contest.seconds + contest.rival_seconds) > 0
    assert "12 props in" in str(found["casting-12-props"].rival)


def test_without_a_gpu_its_row_is_skipped_before_a_world_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "find_gpu", lambda: False)
    skipped = sensor_contests(BenchSite(scenario="no/such"))["session-19-sub-rays-gpu"]()
    assert isinstance(skipped, SkippedContest)
    assert (skipped.reason, skipped.seconds, skipped.target) == ("no GPU, or no extra `gpu`", (), 10.0)


def test_the_rival_finds_what_we_find(site: BenchSite) -> None:
    model, data = compile_model([site.wall], crowd(site, 12))
    rays = site.rays
    ranges_m, ids, _ = Caster(model_meshes(model, data)).cast_columns(rays.origins, rays.directions)
    directions = rays.directions.reshape(-1, 3).astype(np.float64)
    expected_m, expected_ids = mujoco_hits(model, data, rays.origins[0], directions)
    same = ids.ravel() == expected_ids
    assert same.mean() > 0.998  # round props have 64 sides here
    is_flat = same & (model.geom_type[expected_ids] != mujoco.mjtGeom.mjGEOM_CYLINDER)
    assert is_flat.mean() > 0.9
    np.testing.assert_allclose(ranges_m.ravel()[is_flat], expected_m[is_flat], atol=1e-4)


def test_the_crowd_stands_on_the_floor_and_off_the_sensor(site: BenchSite) -> None:
    standing = crowd(site, 12)
    assert len(standing) == 12
    assert {item.prop.kind for item in standing} == {"box", "barrel"}
    model, _ = compile_model([site.wall], standing)
    assert model.ngeom == 1 + sum(len(item.shape.solids) for item in standing)
    floor = Caster([site.wall])
    for item in standing:
        place = item.world_T_object[:3, 3]
        down_m = floor.cast(place[None] + [[0.0, 0.0, 0.5]], np.array([[0.0, 0.0, -1.0]]))[0][0]
        assert down_m == pytest.approx(0.5, abs=1e-3)
        assert np.linalg.norm(place - site.rays.origins[0]) > 1.0
        assert min(solid_mesh(solid).vertices[:, 2].min() for solid in item.shape.solids) == pytest.approx(
            0.0, abs=0.02
        )


def test_a_session_is_held_against_the_time_it_took_to_record(site: BenchSite) -> None:
    drive = spread_drive(site)
    assert drive.scenario.sensor.sub_rays == 19
    assert 2 <= drive.trajectory.n_scans < site.drive.trajectory.n_scans / 5
    assert drive.trajectory.true is site.drive.trajectory.true  # the same way
    contest = time_session(site, drive, 1.0)
    n_scans = drive.trajectory.n_scans
    assert (contest.unit, contest.work, contest.target) == ("revolutions/s", n_scans, 1.0)
    assert contest.rival_seconds == (pytest.approx(n_scans * 0.1),)
    assert len(contest.seconds) == 3


def test_a_dusty_session_has_dust_and_second_returns(site: BenchSite, tmp_path: Path) -> None:
    drive = dusty_drive(site)
    assert drive.trajectory is site.drive.trajectory  # the same revolutions
    few = replace(drive, trajectory=spread_drive(site).trajectory)
    with ThreadPoolExecutor(1) as pool:
        write_session(few, tmp_path / "before", pool, report_nothing)
    session = read_session(tmp_path / "before")
    assert session.n_returns == 2
    assert any((instance == AIR).any() for instance, _ in read_labels(session.path, session.n_chunks))


def test_measuring_leaves_nothing_behind(site: BenchSite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    contest = time_session(site, spread_drive(site), 1.0)
    assert isinstance(contest, Contest)
    assert list(tmp_path.iterdir()) == []
