"""Dust that vehicles raise: its mass, where it is, and what the sensor sees of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose
from cdpipe.io.session import read_session
from scenarios import load_scenario
from scenarios.schema import Air, Dust, Scenario, SessionPlan
from sim.movers.trails import raise_dust
from sim.sensor.air import AIR, air_around
from sim.sensor.plumes import DIFFUSIVITY_M2_PER_S, LIFE_S, SETTLING_S, WAKE_SIGMA_M, Puffs, fill_lattice
from sim.session.planning import plan_drives
from sim.session.revolution import find_air
from sim.session.truth import read_labels

AXES = [np.arange(-12.0, 12.1, 0.5), np.arange(-12.0, 12.1, 0.5), np.arange(0.25, 12.0, 0.5)]
STILL = np.zeros(3)


def puff(age_s: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), mass_mg: float = 100.0) -> Puffs:
    return Puffs(np.array([at]), np.array([age_s]), np.array([mass_mg]))


@pytest.mark.parametrize("age_s", [0.0, 20.0, 60.0])
def test_a_puff_keeps_its_mass_but_for_what_settles(age_s: float) -> None:
    total_mg = fill_lattice(puff(age_s), STILL, AXES).sum() * 0.5**3
    assert total_mg == pytest.approx(100.0 * np.exp(-age_s / SETTLING_S), rel=0.02)


def test_a_puff_spreads_and_drifts() -> None:
    density = fill_lattice(puff(60.0), np.array([0.05, 0.0, 0.0]), AXES).astype(np.float64)
    along = density.sum(axis=(1, 2))
    mean = (along * AXES[0]).sum() / along.sum()
    assert mean == pytest.approx(3.0, abs=0.02)
    spread_m2 = (along * (AXES[0] - mean) ** 2).sum() / along.sum()
    assert spread_m2 == pytest.approx(WAKE_SIGMA_M**2 + 2 * DIFFUSIVITY_M2_PER_S * 60.0, rel=0.02)


def body(rate: float | None, speed_mps: float) -> Any:
    def pose(time_s: Float64Array) -> Float64Array:
        return make_pose(np.tile(np.eye(3), (len(time_s), 1, 1)), np.outer(time_s, (speed_mps, 0.0, 0.0)))

    return SimpleNamespace(mover=SimpleNamespace(dust_mg_per_m=rate), world_T_root=pose)


def test_as_much_is_raised_as_the_way_is_long_and_nothing_by_what_stands() -> None:
    assert raise_dust([body(None, 2.0), body(0.0, 2.0)], 10.0) is None
    puffs = raise_dust([body(300.0, 2.0), body(100.0, 0.0)], 10.0)
    assert puffs is not None
    assert puffs.mass_mg.sum() == pytest.approx(300.0 * 2.0 * LIFE_S)
    assert puffs.age_s.min() > 0
    np.testing.assert_allclose(puffs.raised[:, 0], 2.0 * (10.0 - puffs.age_s))


def test_the_air_behind_a_vehicle_is_dim_and_the_rest_of_the_dust_is_as_before() -> None:
    dust, sensor_m = Dust(mg_per_m3=100, drift_mps=0), np.array([0.0, 0.0, 1.0])
    puffs = puff(5.0, (6.0, 0.0, 0.0), mass_mg=5000.0)
    places = np.array([[6.0, 0.0, 0.6], [-9.0, 3.0, 0.6]], np.float32).T
    plain = air_around(Air(dust=dust), sensor_m, 0.0, 0.0, 1, "after").extinction(places)[0]
    more = air_around(Air(dust=dust), sensor_m, 0.0, 0.0, 1, "after", puffs).extinction(places)[0]
    alone = air_around(Air(), sensor_m, 0.0, 0.0, 1, "after", puffs).extinction(places)[0]
    assert more[0] > 1.5 * plain[0]
    assert more[1] == plain[1] > 0
    assert alone[1] == 0
    assert alone[0] == pytest.approx(more[0] - plain[0], rel=1e-5)


TRUCK = "movers=[{name: truck, kind: forklift, path: {length_m: 5, lateral: -0.9}, dust_mg_per_m: 3000}]"
LANE = ["before.lateral=0.5", "after.lateral=0.5", "tunnel.section.width_m=6"]
SMALL = ["sensor.mode=512x10", "platform.scan_spacing_m=1", *LANE, TRUCK]


def test_returns_of_a_plume_are_labelled_as_air(simulated_once: Callable[[Scenario, int], Path]) -> None:
    pair = simulated_once(load_scenario("smoke/unchanged", 3, SMALL), 3)
    labels = [instance for instance, _ in read_labels(pair / "after", read_session(pair / "after").n_chunks)]
    assert sum(int((each == AIR).sum()) for each in labels) > 50


def test_a_scene_without_plumes_has_clear_air_and_people_raise_none() -> None:
    clean = [*SMALL[:-1], TRUCK.replace(", dust_mg_per_m: 3000", "")]
    drive = plan_drives(load_scenario("smoke/unchanged", 3, clean), 3)[0]
    assert find_air(drive, 0) is None
    with pytest.raises(ScenarioError, match="a person raises no dust: leave dust_mg_per_m out"):
        load_scenario("smoke/unchanged", 3, ["movers=[{name: p, kind: person, dust_mg_per_m: 3}]"])


def test_the_dust_of_a_recorded_drive_lies_on_its_floor(tmp_path: Path) -> None:
    base = load_scenario("smoke/unchanged", 3, ["before.air.dust.mg_per_m3=100"])
    line = [[4 + 0.5 * step, 0, 2.0, 0, 0, 0, 1] for step in range(12)]  # 1.9 m and more above the floor
    np.savetxt(tmp_path / "t.tum", [[0.5 * step, *pose] for step, pose in enumerate(line)])
    plan = SessionPlan(trajectory=str(tmp_path / "t.tum"), air=base.before.air)
    drive = plan_drives(base.model_copy(update={"before": plan}), 3)[0]
    air = find_air(drive, 0)
    assert air is not None and air.dust is not None
    assert air.dust.floor_z_m == pytest.approx(0.07, abs=0.3)
    driven = plan_drives(base, 3)[0]
    nominal = find_air(driven, 0)
    assert nominal is not None and nominal.dust is not None
    assert nominal.dust.floor_z_m == pytest.approx(
        driven.trajectory.true.sample(driven.trajectory.revolution_s[:1])[0][0, 2] - 0.8
    )
