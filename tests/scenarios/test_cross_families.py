"""Each session may have a sensor and a platform of its own; keys left out are the scenario's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cdpipe
from cdpipe.core.errors import ScenarioError
from cdpipe.io.session import read_session
from scenarios import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.session.planning import plan_drives
from sim.session.simulate import simulate_pair

SEEDS = (*range(8), *range(10000, 10008))
SMALL = ["platform.scan_spacing_m=1", "sensor.mode=512x10"]


@pytest.mark.parametrize(("name", "base"), [("cross/narrow", "narrow"), ("cross/null", "unchanged/narrow")])
def test_a_cross_family_is_its_base_with_a_sensor_for_each_session(name: str, base: str) -> None:
    seen = set()
    for seed in SEEDS:
        crossed, plain = load_scenario(name, seed), load_scenario(base, seed)
        own = {"family": True, "description": True, "before": {"sensor"}, "after": {"sensor"}}
        assert crossed.model_dump(exclude=own) == plain.model_dump(exclude=own)
        sensors = [crossed.of(session).sensor for session in ("before", "after")]
        assert all(sensor.sub_rays == 7 for sensor in sensors)
        seen |= {(sensor.profile, sensor.mode) for sensor in sensors}
        assert crossed.of("before").platform == plain.platform
    assert {profile for profile, _ in seen} >= {"puck-16", "os0-128-nominal", "os1-128-nominal", "os1-32-nominal"}
    assert {mode.split("x")[1] for _, mode in seen} == {"5", "10", "20"}


def test_a_survey_stands_still_every_ten_metres_and_does_not_drift() -> None:
    scenario = load_scenario("cross/survey", 10001)
    before, after = (scenario.of(session) for session in ("before", "after"))
    assert (before.platform.scan_spacing_m, after.platform.scan_spacing_m) == (10, 0.5)
    assert before.platform.wheelbase_m == after.platform.wheelbase_m
    drive = plan_drives(scenario.model_copy(update={"props": (), "areas": ()}), 10001)[0]
    assert drive.sensor.height == 128
    steps_m = np.linalg.norm(np.diff(drive.trajectory.world_T_sensor[:, :3, 3], axis=0), axis=1)
    assert steps_m.min() > 9 and steps_m.max() < 11
    columns = drive.trajectory.world_T_column(slice(0, 1))[0]
    assert np.array_equal(columns[0], columns[-1])
    odometry = drive.trajectory.odom_T_sensor
    np.testing.assert_allclose(np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1), steps_m, atol=1e-9)


def test_what_a_session_leaves_out_is_the_scenarios_and_a_dump_is_read_as_it_was(tmp_path: Path) -> None:
    settings = ["sensor.sub_rays=7", "after.sensor.profile=os0-32-nominal", "before.platform.kind=legged"]
    scenario = load_scenario("smoke/one_box", 3, settings)
    assert scenario.after.sensor is not None and scenario.before.platform is not None
    assert (scenario.after.sensor.sub_rays, scenario.after.sensor.mode) == (7, scenario.sensor.mode)
    assert scenario.before.platform.clearance_m == scenario.platform.clearance_m
    assert scenario.before.platform.gait is not None and scenario.platform.gait is None
    assert scenario.of("before").sensor == scenario.sensor and scenario.of("after").platform == scenario.platform
    assert Scenario.model_validate(scenario.model_dump(mode="json")) == scenario
    # a key that is as by default is told apart from one that is left out
    usual = ["sensor.returns=dual", "before.sensor.returns=strongest", "platform.mount_yaw_deg=90"]
    turned = load_scenario("smoke/one_box", 3, [*usual, "after.platform.mount_yaw_deg=0"])
    again = Scenario.model_validate(turned.model_dump(mode="json"))
    assert again == turned
    assert (again.of("before").sensor.returns, again.of("after").sensor.returns) == ("strongest", "dual")
    assert (again.of("before").platform.mount_yaw_deg, again.of("after").platform.mount_yaw_deg) == (90, 0)
    gaits = ["platform.kind=legged", "platform.gait.step_hz=3.3", "after.platform.gait.bob_m=0.1"]
    gait = load_scenario("smoke/one_box", 3, gaits).of("after").platform.gait
    assert gait is not None and (gait.step_hz, gait.bob_m) == (3.3, 0.1)
    plain = load_scenario("smoke/one_box", 3)
    assert plain.of("after") is plain
    assert not {"sensor", "platform"} & plain.model_dump(mode="json")["after"].keys()
    # a walker's session drives on wheels in the other one
    walks = load_scenario("odometry/legged", 10001, ["after.platform.kind=ground_robot"])
    assert walks.after.platform is not None and walks.after.platform.gait is None


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        (["after.sensor.profile=os9"], "after.sensor.profile = 'os9': sensor profile 'os9' is unknown"),
        (["before.sensor.mode=77x10"], "before.sensor.mode = '77x10'"),
        (["before.sensor.min_range_m=200"], "leaves nothing below max_range_m"),
        (
            ["platform.clearance_m=3", "before.platform.clearance_m=0.5"],
            ": platform.clearance_m = 3: leaves the platform",
        ),
        (["after.platform.clearance_m=3"], "after.platform.clearance_m = 3: leaves the platform no room"),
        (["after.platform.sensor_height_m=9"], "after.platform.sensor_height_m = 9: the sensor would be above"),
        (["after.platform.scan_spacing_m=500"], "after.platform.scan_spacing_m = 500"),
        (["after.sensor.profile=nowhere.json"], "after.sensor.profile = 'nowhere.json': no such file"),
    ],
)
def test_a_mistake_in_a_sessions_own_part_is_named_there(settings: list[str], rule: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("smoke/one_box", 3, settings)
    (line,) = str(caught.value).splitlines()
    assert rule in line
    if not rule.startswith(": "):
        assert ": sensor." not in line and ": platform." not in line


def test_a_mistake_of_the_scenarios_part_is_not_told_again_of_the_session_that_has_it_from_there() -> None:
    wrong = ["sensor.returns=both", "platform.track_m=-1"]
    own = ["after.sensor.profile=os0-32-nominal", "before.platform.wheelbase_m=1", "after.sensor.min_range_m=-2"]
    with pytest.raises(ScenarioError) as caught:
        load_scenario("smoke/one_box", 3, [*wrong, *own])
    keys = [line.split(" = ")[0] for line in str(caught.value).splitlines()]
    assert sorted(keys) == ["--set: after.sensor.min_range_m", "--set: platform.track_m", "--set: sensor.returns"]


def test_the_file_of_a_sessions_own_profile_counts(tmp_path: Path) -> None:
    source = Path(cdpipe.__file__).parent / "sensor" / "profiles" / "os1-32-g.json"
    own = tmp_path / "own.json"
    own.write_bytes(source.read_bytes())
    scenario = load_scenario("smoke/one_box", 3, [f"after.sensor.profile={own}"])
    assert list(file_digests(scenario)) == [str(own)]


def test_the_other_session_keeps_its_bytes_and_a_change_is_found_across_sensors(tmp_path: Path) -> None:
    settings = [*SMALL, "after.sensor.profile=os0-32-nominal", "after.sensor.mode=1024x10"]
    simulate_pair(
        load_scenario("smoke/one_box", 3, [*SMALL, "after.odometry.translation_percent=0"]), 3, tmp_path / "one"
    )
    simulate_pair(load_scenario("smoke/one_box", 3, settings), 3, tmp_path / "two")
    one, two = (read_session(tmp_path / name / "before") for name in ("one", "two"))
    assert (tmp_path / "one/before/chunks/00000.npz").read_bytes() == (
        tmp_path / "two/before/chunks/00000.npz"
    ).read_bytes()
    after = read_session(tmp_path / "two" / "after")
    assert (one.sensor.product, one.sensor.width) == (two.sensor.product, two.sensor.width) == ("OS-1-32-U", 512)
    assert (after.sensor.product, after.sensor.width) == ("OS-0-32-U", 1024)
    report = cdpipe.detect(tmp_path / "two" / "before", tmp_path / "two" / "after")
    assert [each.kind for each in report.objects] == ["added"]
