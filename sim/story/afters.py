"""Several after sessions of one world: the same before session and the same changes, driven again each time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from scenarios.references import file_digests
from scenarios.schema import Scenario, SessionPlan
from sim.scene import World, build_world
from sim.session.labels import Returns, Tally
from sim.session.planning import make_drive, plan_drives_in
from sim.session.revolution import Drive
from sim.session.simulate import HeldPair, collect_truth, hold_session
from sim.story.curtains import refuse_moved_curtains
from sim.story.world import plan_alone


def simulate_afters(scenario: Scenario, plans: Sequence[SessionPlan], seed: int) -> Iterator[HeldPair]:
    """Yield the pair of a scenario, then for each further plan a pair of the same before session and another after one.

    The first pair equals, to the byte, that of `simulate_in_memory`. World and before session are made once. The n-th
    after session draws its line, its noise and its odometry under the name `session-NN`, so that it is the same
    however many follow it.

    Args:
        scenario: The scenario as drawn.
        plans: The drive of each further after session.
        seed: Draws everything the scenario leaves open.

    Raises:
        InputError: The sensor profile or another file cannot be read.
        ScenarioError: The world contradicts itself, a drive finds no way, rock changes in the scenario, the odometry
            of a further session is a file, or a curtain would hang elsewhere in one of the sessions.
    """
    _refuse_unsuited(scenario, plans)
    files, world = file_digests(scenario), build_world(scenario, seed)
    before, after = plan_drives_in(world, scenario, seed)
    further = [
        _plan_after(world, scenario, plan, (seed, number), before.tallies) for number, plan in enumerate(plans, start=2)
    ]
    curtains: dict[str, Float64Array] = {}
    for drive in (before, after, *(drive for _, drive in further)):
        refuse_moved_curtains(drive.name, drive.moving.movers, curtains)
    with ThreadPoolExecutor(1) as pool:
        held = hold_session(before, pool)
        seen = [_copy_tally(tally) for tally in before.tallies]
        for own, drive in ((scenario, after), *further):
            tallies = before.tallies if drive is after else tuple(_copy_tally(tally) for tally in seen)
            drives = replace(before, tallies=tallies), replace(drive, tallies=tallies)
            sessions = {"before": held, "after": hold_session(drives[1], pool)}
            yield HeldPair(
                collect_truth(own, seed, drives, files), {name: sessions[name] for name in ("before", "after")}
            )


def _refuse_unsuited(scenario: Scenario, plans: Sequence[SessionPlan]) -> None:
    if scenario.surface and plans:
        raise ScenarioError("surface: where rock changes, one after session is simulated: leave out `--afters`")
    for plan in plans:
        if plan.odometry.file is not None:
            raise ScenarioError(
                f"after.odometry.file = {plan.odometry.file}: the poses of one drive, and each further after session "
                "has a drive of its own: give an odometry.source, or leave out `--afters`"
            )


def _plan_after(
    world: World, scenario: Scenario, plan: SessionPlan, key: tuple[int, int], tallies: tuple[Tally, ...]
) -> tuple[Scenario, Drive]:
    """Return a scenario with another after session, and its drive; the key is the seed and the session's number."""
    own, name = scenario.model_copy(update={"after": plan}), f"session-{key[1]:02d}"
    standing = tuple(replace(item, sessions=frozenset({name})) for item in world.standing if "after" in item.sessions)
    here = replace(world, before=world.after, standing=standing)
    return own, make_drive("after", plan_alone(own, world.centreline, here, (name, "after"), key[0]), tallies)


def _copy_tally(tally: Tally) -> Tally:
    """Return a tally that goes on counting from here, apart from the first one."""
    own, other = (Returns(each.n, copy(each.cells)) for each in (tally.own, tally.other))
    return replace(tally, own=own, other=other)
