"""Further after sessions of one world, against pairs that are simulated on their own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from scenarios.library import load_scenario
from scenarios.schema import Odometry
from sim.movers.mover import MovingBody
from sim.session.simulate import HeldPair, simulate_in_memory
from sim.story.afters import simulate_afters
from sim.story.curtains import refuse_moved_curtains

FAMILY, SEED = "smoke/one_box", 5


def ranges_mm(pair: HeldPair, session: str) -> np.ndarray:
    held = pair.sessions[session].session  # type: ignore[index]
    return np.concatenate([held.chunk(number).range_mm for number in range(held.n_chunks)])


def test_a_curtain_that_would_hang_elsewhere_is_refused() -> None:
    def hung(x_m: float, kind: str = "curtain") -> MovingBody:
        course = SimpleNamespace(points=np.array([[x_m, 1.0, 2.0]]))
        return cast(MovingBody, SimpleNamespace(mover=SimpleNamespace(kind=kind, name="c"), course=course))

    curtains: dict[str, np.ndarray] = {}
    for place in (hung(3.0), hung(3.0), hung(5.0, "person")):
        refuse_moved_curtains("after", [place], curtains)
    with pytest.raises(ScenarioError, match="session-02: mover 'c': the curtain finds no way where it hung before"):
        refuse_moved_curtains("session-02", [hung(5.0)], curtains)


@pytest.fixture(scope="module", name="pairs")
def pairs_fixture() -> list[HeldPair]:
    scenario = load_scenario(FAMILY, SEED)
    return list(simulate_afters(scenario, [scenario.after, scenario.after], SEED))


def test_the_first_pair_is_that_of_a_scenario_without_further_sessions(pairs: list[HeldPair]) -> None:
    alone = simulate_in_memory(load_scenario(FAMILY, SEED), SEED)
    assert repr(pairs[0].truth) == repr(alone.truth)
    for name in ("before", "after"):
        np.testing.assert_array_equal(ranges_mm(pairs[0], name), ranges_mm(alone, name))
        np.testing.assert_array_equal(pairs[0].sessions[name].change, alone.sessions[name].change)  # type: ignore[index]


def test_each_after_session_is_another_drive_past_the_same_changes(pairs: list[HeldPair]) -> None:
    first, *others = pairs
    for pair in others:
        assert pair.sessions["before"] is first.sessions["before"]
        assert not np.array_equal(ranges_mm(pair, "after"), ranges_mm(first, "after"))
        for change, same in zip(pair.truth.changes, first.truth.changes, strict=True):
            assert (change.name, change.kind, change.world_T_object) == (same.name, same.kind, same.world_T_object)
            # An added object has its returns in the after session, and its ghost is met by rays of the before session.
            assert change.kind == "added"
            assert change.n_returns == np.count_nonzero(pair.sessions["after"].change == change.id)
            assert change.n_ghost_rays == same.n_ghost_rays > 0
    assert not np.array_equal(ranges_mm(pairs[1], "after"), ranges_mm(pairs[2], "after"))


def test_a_session_is_the_same_however_many_follow_it(pairs: list[HeldPair]) -> None:
    scenario = load_scenario(FAMILY, SEED)
    fewer = list(simulate_afters(scenario, [scenario.after], SEED))
    assert len(fewer) == 2
    np.testing.assert_array_equal(ranges_mm(fewer[1], "after"), ranges_mm(pairs[1], "after"))
    assert repr(fewer[1].truth) == repr(pairs[1].truth)


def test_changing_rock_is_refused() -> None:
    scenario = load_scenario("surface/scar", SEED)
    with pytest.raises(ScenarioError, match="--afters"):
        next(simulate_afters(scenario, [scenario.after], SEED))


def test_poses_of_one_drive_are_refused_for_another() -> None:
    scenario = load_scenario(FAMILY, SEED)
    told = scenario.after.model_copy(update={"odometry": Odometry(file="own.tum")})
    with pytest.raises(ScenarioError, match=r"after\.odometry\.file = own\.tum: .*: give an odometry\.source"):
        next(simulate_afters(scenario, [scenario.after, told], SEED))
