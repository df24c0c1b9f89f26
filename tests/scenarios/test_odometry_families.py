"""The families `odometry/*`: known pairs with an odometry as it is, on every platform."""

from functools import cache

import pytest

from scenarios import load_scenario, scenario_names
from scenarios.schema import FITTED_WALK, Odometry, Platform, Scenario

SEEDS = (10000, 10001, 10002, 20000, 20001)
drawn = cache(load_scenario)


def worlds(scenario: Scenario, *left_out: str) -> Scenario:
    """The scenario without names, odometry and some figures of its platform."""
    sessions = {
        name: getattr(scenario, name).model_copy(update={"odometry": Odometry(), "speed_mps": None})
        for name in ("before", "after")
    }
    usual = {key: getattr(Platform(), key) for key in left_out}
    platform = scenario.platform.model_copy(update=usual)
    return scenario.model_copy(update={**sessions, "platform": platform, "family": "", "description": ""})


def base_of(name: str) -> str:
    word = name.removeprefix("odometry/").split("-")
    return word[1] if len(word) > 1 else "narrow"


@pytest.mark.parametrize("name", [name for name in scenario_names() if name.startswith("odometry/")])
def test_only_odometry_platform_and_spacing_differ_from_the_family_of_the_tunnels(name: str) -> None:
    platform = tuple(Platform.model_fields)
    kept = () if name.startswith(("odometry/kiss", "odometry/walk")) else ("clearance_m",)
    left_out = (
        [key for key in platform if key not in kept] if kept else ["scan_spacing_m", "speed_mps", "speed_variation"]
    )
    for seed in SEEDS:
        scenario, base = drawn(name, seed), drawn(base_of(name), seed)
        assert worlds(scenario, *left_out) == worlds(base, *left_out)
        assert scenario.platform.scan_spacing_m == (0.15 if name.endswith("-dense") else 0.5)
        assert scenario.before.odometry == scenario.after.odometry
        assert scenario.before.odometry.source == ("kiss-icp" if "kiss" in name else "random-walk")


def test_every_walk_is_as_large_as_one_of_the_fits() -> None:
    for name in ("walk-narrow", "walk-wide", "walk-cave", "walk-network"):
        odometry = drawn(f"odometry/{name}", 10000).before.odometry
        for key, usual in FITTED_WALK.items():
            assert usual / 4 <= getattr(odometry, key) <= 4 * usual or key.endswith("length_m")
    assert drawn("odometry/walk-network", 1).before.odometry == drawn("odometry/walk-narrow", 1).before.odometry


def test_platforms_and_mounts() -> None:
    kinds = {name: {drawn(f"odometry/{name}", seed).platform.kind for seed in SEEDS} for name in ("handheld", "legged")}
    assert kinds == {"handheld": {"handheld"}, "legged": {"legged"}}
    assert drawn("odometry/quadrotor", 10000).platform.kind == "quadrotor"
    gaits = [drawn("odometry/handheld", seed).platform.gait for seed in SEEDS]
    assert all(gait is not None and 1.25 <= gait.step_hz <= 1.9 for gait in gaits)
    mounts = [drawn("odometry/turned", seed).platform for seed in range(40)]
    assert {mount.mount_pitch_deg for mount in mounts} == {-20.0, 20.0}
    yaws = [mount.mount_yaw_deg for mount in mounts]
    assert min(yaws) < -120 and max(yaws) > 120
