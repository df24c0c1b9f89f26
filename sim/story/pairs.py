"""Two sessions of a story as a pair: their folders, and the truth of what changed between them."""

from __future__ import annotations

import filecmp
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.files import require_plain_file
from cdpipe.core.progress import Progress, report_nothing
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.scene import Ground, World, lay_ground
from sim.session.labels import list_changes
from sim.session.planning import PlannedSession, pair_drives
from sim.session.revolution import Drive
from sim.session.simulate import THREADS, collect_truth, write_session
from sim.session.truth import SESSIONS, PairTruth, write_pair_truth
from sim.story.simulate import list_sessions_files, refuse_unsuited
from sim.story.state import SessionState, Story, find_mistakes, read_story
from sim.story.world import build_session_world, pair_worlds, plan_session


class PairMaker:
    """Makes pairs of one story; its ground is laid once.

    Args:
        folder: The folder of the story.

    Raises:
        InputError: The story is damaged, or a file of its scenario is not the one that it was made with.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.story = folder, read_story(folder)
        refuse_unsuited(self.story.scenario)
        for name, digest in file_digests(self.story.scenario).items():
            if self.story.files.get(name) != digest:
                raise InputError(f"{name}: is not the file that {folder} was made with: put that one back")

    def make(self, before: int, after: int, out: Path, on_progress: Progress | None = None) -> PairTruth:
        """Write a pair into a folder: before, after, truth.

        Both sessions are simulated again, because what is mixed, and what the rays of one session would meet, depends
        on the pair. Their files must be those of the story, and then are hard links to these, or copies where the file
        system has no links.

        Args:
            before: Number of the before session, 1-based.
            after: Number of the after session; it may be the earlier one.
            out: An empty folder.
            on_progress: Called with the stage and how much of how much is done.

        Raises:
            InputError: There is no such session, the pair has no exact truth, the sessions were made by another
                version, or nothing can be written.
        """
        states = self._choose(before, after)
        report = on_progress or report_nothing
        report("world", 0, 1)
        paired, drives = self._plan(states)
        report("world", 1, 1)
        try:
            with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as pool:
                for drive in drives:
                    write_session(drive, out / drive.name, pool, report)
                    _link_files(self.folder / drive.session, out / drive.name)
            truth = collect_truth(paired, self.story.seed, drives, self.story.files)
            truth = replace(truth, story=describe_pair(self.story, states))
            write_pair_truth(out, truth)
        except OSError as error:
            raise InputError(f"{out}: cannot write there: {error.strerror or error}") from error
        return truth

    @cached_property
    def _ground(self) -> Ground:
        return lay_ground(self.story.scenario, self.story.seed)

    def _choose(self, before: int, after: int) -> tuple[SessionState, SessionState]:
        n_sessions = len(self.story.sessions)
        for number in (before, after):
            if not 1 <= number <= n_sessions:
                raise InputError(f"session {number}: {self.folder} has sessions 1 to {n_sessions}")
        if before == after:
            raise InputError(f"sessions {before} and {after}: a pair is of two different sessions")
        states = self.story.sessions[before - 1], self.story.sessions[after - 1]
        for prop in self.story.scenario.props:
            places = [state.places.get(prop.name) for state in states]
            if prop.change == "reshaped" and places == ["after", "before"]:
                raise InputError(
                    f"sessions {before} and {after}: pile {prop.name!r} was loaded away between them, and the truth of "
                    f"a pile that grows is not defined: give {after} {before}"
                )
        return states

    def _plan(self, states: tuple[SessionState, SessionState]) -> tuple[Scenario, list[Drive]]:
        scenario, world, planned = plan_pair(self.story.scenario, self.story.seed, self._ground, states)
        return scenario, pair_drives(world, planned, list_changes(scenario, world))


def plan_pair(
    scenario: Scenario, seed: int, ground: Ground, states: tuple[SessionState, SessionState]
) -> tuple[Scenario, World, list[PlannedSession]]:
    """Return the scenario and the world of a pair, and its two planned sessions, before first."""
    worlds = [build_session_world(scenario, ground, state) for state in states]
    planned = [plan_session(scenario, ground, world, state, seed) for world, state in zip(worlds, states, strict=True)]
    paired, world = pair_worlds(scenario, ground, states, (worlds[0], worlds[1]))
    return paired, world, planned


def describe_pair(story: Story, states: tuple[SessionState, SessionState]) -> dict[str, Any]:
    """Return what the truth of a pair says of its story: enough to build its world again."""
    told = dict(zip(SESSIONS, (state.model_dump(mode="json") for state in states), strict=True))
    return {"n_sessions": len(story.sessions), **told, "scenario": story.scenario.model_dump(mode="json")}


def rebuild_pair(truth: PairTruth) -> tuple[World, list[PlannedSession]]:
    """Return the world of a pair of a story and its two planned sessions, before first, from what its truth says.

    Raises:
        InputError: The truth does not hold a story, or not one of this version.
    """
    story = truth.story or {}
    try:
        scenario = Scenario.model_validate(story.get("scenario"))
        states = SessionState.model_validate(story.get("before")), SessionState.model_validate(story.get("after"))
    except ValidationError as error:
        raise InputError(f"the story is not one of this version ({error.errors()[0]['msg']})") from error
    for state in states:
        for mistake in find_mistakes(scenario, state):
            raise InputError(f"the story does not fit its scenario: {state.name}: {mistake}")
    _, world, planned = plan_pair(scenario, truth.seed, lay_ground(scenario, truth.seed), states)
    return world, planned


def _link_files(stored: Path, made: Path) -> None:
    """Replace the files of a session that was made again by links to those of the story, which must be the same.

    Raises:
        InputError: They differ.
        OSError: A file cannot be replaced.
    """
    for name in list_sessions_files(made):
        require_plain_file(stored / name, expected="simulate the story again")
        if not filecmp.cmp(stored / name, made / name, shallow=False):
            raise InputError(
                f"{stored / name}: is not what this version of tunnelcd simulates: simulate the story again, or use "
                "the versions that its story.json names"
            )
        link = made / name.with_name(f".{name.name}.link")
        try:
            link.hardlink_to(stored / name)
        except OSError:  # another file system, or one without links: the copy stays
            continue
        link.replace(made / name)
