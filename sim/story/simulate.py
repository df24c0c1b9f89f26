"""Simulates a story: every session of it, each with its own truth, and story.json."""

from __future__ import annotations

import hashlib
import json
import os
from concurrent.futures import Executor, ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.plugins import require_extra
from cdpipe.core.progress import Progress, report_nothing
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.scene import lay_ground
from sim.session.planning import PlannedSession, make_drive
from sim.session.simulate import THREADS, write_session
from sim.story.curtains import refuse_moved_curtains
from sim.story.schedule import draw_states
from sim.story.state import FEWEST, MOST, Story, dump_story
from sim.story.world import build_session_world, plan_session

_PACKAGES = ("tunnelcd", "numpy", "scipy", "mujoco", "embreex", "kiss-icp")


def simulate_story(
    scenario: Scenario, seed: int, n_sessions: int, folder: Path, on_progress: Progress | None = None
) -> Story:
    """Write `session-01` to `session-NN` and `story.json` into a folder.

    The same scenario, seed and number of sessions give the same bytes, whatever the number of threads.

    Args:
        scenario: The scenario as drawn.
        seed: Draws everything the scenario leaves open.
        n_sessions: 3 to 12.
        folder: An empty folder.
        on_progress: Called with the stage ("world", then the name of each session) and how much of how much is done.

    Raises:
        InputError: A file cannot be read or written, or an extra is missing.
        ScenarioError: The world contradicts itself, or the scenario cannot be a story.
    """
    if not FEWEST <= n_sessions <= MOST:
        raise InputError(f"n_sessions = {n_sessions}: a story has {FEWEST} to {MOST} sessions")
    refuse_unsuited(scenario)
    report = on_progress or report_nothing
    files = file_digests(scenario)
    report("world", 0, 1)
    ground = lay_ground(scenario, seed)
    states = draw_states(scenario, ground, seed, n_sessions)
    report("world", 1, 1)
    curtains: dict[str, Float64Array] = {}
    try:
        with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as pool:
            for state in states:
                world = build_session_world(scenario, ground, state)
                planned = plan_session(scenario, ground, world, state, seed)
                refuse_moved_curtains(planned.own_name, planned.movers, curtains)
                _write(planned, folder / state.name, pool, report)
        digests = {state.name: digest_files(folder / state.name) for state in states}
        versions = list_versions()
        story = Story(scenario=scenario, seed=seed, sessions=states, files=files, digests=digests, versions=versions)
        (folder / "story.json").write_text(json.dumps(dump_story(story), indent=1))
    except OSError as error:
        raise InputError(f"{folder}: cannot write there: {error.strerror or error}") from error
    return story


def refuse_unsuited(scenario: Scenario) -> None:
    """Refuse a scenario that cannot be a story.

    Raises:
        ScenarioError: Its odometry is a file, which is of one drive.
        InputError: It asks for KISS-ICP, and that is not installed.
    """
    for name in ("before", "after"):
        odometry = scenario.plan(name).odometry
        if odometry.file is not None:
            raise ScenarioError(
                f"{name}.odometry.file = {odometry.file}: the poses of one drive, and each session of a story has a "
                "drive of its own: give an odometry.source"
            )
        if odometry.source == "kiss-icp":
            require_extra("odometry", "odometry.source = kiss-icp")


def list_sessions_files(session: Path) -> list[Path]:
    """Return the files of a session without its truth, sorted, relative to it."""
    found = (path.relative_to(session) for path in session.rglob("*") if path.is_file())
    return sorted(path for path in found if path.parts[0] != "truth")


def digest_files(session: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a session without its truth."""
    found = {}
    for name in list_sessions_files(session):
        with (session / name).open("rb") as file:
            found[name.as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def list_versions() -> dict[str, str]:
    """Return the versions of the packages that decide the bytes of a session, of those that are installed."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _write(planned: PlannedSession, folder: Path, pool: Executor, report: Progress) -> None:
    write_session(make_drive("before", planned), folder, pool, report)
