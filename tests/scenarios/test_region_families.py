"""The families of the plans `regions`, `null` and `calibrate`: known pairs with another odometry, and nothing else."""

from functools import cache

import pytest

from scenarios import load_scenario, scenario_names
from scenarios.schema import Odometry, Scenario

SEEDS = range(12)
SITES = {"site1": "paper/site1", "site2": "paper/site2"}
drawn = cache(load_scenario)


def without_odometry(scenario: Scenario) -> Scenario:
    sessions = {
        name: getattr(scenario, name).model_copy(update={"odometry": Odometry()}) for name in ("before", "after")
    }
    return scenario.model_copy(update={**sessions, "family": "", "description": ""})


def families(prefix: str) -> list[str]:
    return [name.removeprefix(prefix) for name in scenario_names() if name.startswith(prefix)]


@pytest.mark.parametrize("name", families("regions/"))
def test_regions_are_the_pairs_of_the_family_with_three_tenths_of_drift(name: str) -> None:
    drift = Odometry(translation_percent=0.3, yaw_deg_per_100m=0.3)
    for seed in SEEDS:
        scenario, base = drawn(f"regions/{name}", seed), drawn(SITES.get(name, name), seed)
        assert (scenario.before.odometry, scenario.after.odometry) == (drift, drift)
        assert without_odometry(scenario) == without_odometry(base)


@pytest.mark.parametrize("name", families("null/"))
def test_null_is_the_unchanged_pair_with_a_drift_of_its_own_in_either_session(name: str) -> None:
    drifts = []
    for seed in SEEDS:
        scenario = drawn(f"null/{name}", seed)
        assert without_odometry(scenario) == without_odometry(drawn(f"unchanged/{name}", seed))
        assert scenario.before.odometry != scenario.after.odometry
        drifts += [scenario.before.odometry, scenario.after.odometry]
        assert all(prop.change == "none" for prop in scenario.props)
    for errors in ([o.translation_percent for o in drifts], [o.yaw_deg_per_100m for o in drifts]):
        # uniform from 0 to 0.5: of 24 draws one is below a quarter, one above, and the mean is near the middle
        assert 0 <= min(errors) < 0.125 < 0.375 < max(errors) <= 0.5
