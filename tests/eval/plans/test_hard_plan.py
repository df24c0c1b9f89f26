"""Worlds of plan `hard` as built: that a score can be reached at every range."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from eval.plans.axes import Step, world_of_step
from scenarios import load_scenario
from sim.drive.path import plan_path
from sim.scene import build_world
from tests.eval.plans.shipped import plan_of

SEED = 10001
KEYFRAMES_M = 1.0
N_STEPS = 5


def steps() -> tuple[Step, ...]:
    """Return the steps of the axis `range`."""
    found = next(axis for axis in plan_of("hard").axes if axis.name == "range").steps
    assert len(found) == N_STEPS
    return found


def ranges_m(settings: tuple[str, ...]) -> tuple[list[float], float]:
    """Return the distance from every change to the farther of the two driven lines, and the score radius."""
    scenario = load_scenario("hard/drift", SEED, settings)
    world = build_world(scenario, SEED)
    places = np.array([item.world_T_object[:3, 3] for item in world.standing if item.prop.change != "none"])
    lines = [cKDTree(plan_path(world, scenario, SEED, session).points) for session in ("before", "after")]
    found: list[float] = np.maximum(*(np.asarray(line.query(places)[0]) for line in lines)).tolist()
    return found, scenario.score_radius_m


@pytest.mark.parametrize(
    "number", [1, *(pytest.param(step, marks=pytest.mark.soak) for step in (0, 2, 3)), N_STEPS - 1]
)
def test_a_region_at_a_keyframe_can_find_a_change_at_every_range(number: int) -> None:
    step = steps()[number]
    found, score_radius_m = ranges_m(step.set)
    assert np.hypot(max(found), KEYFRAMES_M / 2) < score_radius_m
    assert abs(np.median(found) - float(step.value)) < 0.6


def test_all_ranges_are_scored_alike() -> None:
    plan = plan_of("hard")
    assert len({setting for step in steps() for setting in step.set if setting.startswith("score_radius_m")}) == 1
    assert all(any(setting.startswith("score_radius_m") for setting in step.set) for step in steps())
    # a radius of one preset that differs between steps would be a difficulty of its own
    assert {world_of_step(plan.base, step) for step in steps()} == set(plan.wide)
