"""What stays the same while props are cast into the sessions of a pair: its parts, its props, and its noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpipe.core.geometry import Float64Array, Int32Array
from cdpipe.core.progress import Progress
from cdpipe.io.session import Session
from scenarios.grafted import GraftScenario
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.graft.casting import Props
from sim.graft.noise import RangeNoise, measure_noise, measure_step_mm
from sim.graft.part import Part
from sim.graft.rock import Patch, find_rock
from sim.graft.splitting import split_scans
from sim.graft.standing import stand_props
from sim.graft.surroundings import Surroundings
from sim.placement.contact import standing_surface
from sim.placement.placing import Standing
from sim.session.labels import Tally, list_changes
from sim.session.truth import SESSIONS, SessionName

ONE_RECORDING = "one recording"


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """The recordings of a pair, opened.

    Attributes:
        sessions: One that is split, or two of one place, before first.
        before_T_after: (4, 4) transform of the second one's odom frame into that of the first; None for one recording.
        merge_from: Where that is from: "given", "tunnelcd", or `ONE_RECORDING`.
    """

    sessions: tuple[Session, ...]
    before_T_after: Float64Array | None = None
    merge_from: str = ONE_RECORDING


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The props of one session: the surface of each, world frame, and its number in the scenario."""

    meshes: tuple[Mesh, ...]
    instance: Int32Array


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """The props of a pair, as `sim.session.labels.list_changes` compares them."""

    standing: Sequence[Standing]
    before: Surfaces
    after: Surfaces


@dataclass(frozen=True, slots=True, eq=False)
class Graft:
    """A pair that is to be grafted.

    Attributes:
        scenario, seed: What is grafted.
        recorded: The recordings.
        split: How one recording was split; "two recordings" for two.
        parts: The two sessions, before first.
        props: The props of each.
        noises: What the recording of each shows of its noise; empty where nothing is grafted.
        standing: Every prop at each of its places.
        tallies: The changes.
        rock: The rock that moves between them.
        steps_mm: Step of the ranges of each session, where rock moves.
    """

    scenario: GraftScenario
    seed: int
    recorded: Recorded
    split: str
    parts: tuple[Part, Part]
    props: tuple[Props, Props]
    noises: tuple[RangeNoise, ...]
    standing: tuple[Standing, ...]
    tallies: tuple[Tally, ...]
    rock: tuple[Patch, ...] = ()
    steps_mm: tuple[int, ...] = ()

    def describe(self) -> dict[str, Any]:
        """Return what the truth tells beside the changes."""
        return {
            "recordings": [session.path.name for session in self.recorded.sessions],
            "split": self.split,
            "merge_from": self.recorded.merge_from,
            "before_T_after": self.parts[1].world_T_odom.tolist(),
            "props": [
                {
                    "name": item.prop.name,
                    "sessions": sorted(item.sessions),
                    "loaded": item.prop.loaded_share is not None and item.sessions == {"after"},
                    "world_T_object": item.world_T_object.tolist(),
                }
                for item in self.standing
            ],
            "noise": [noise.describe() for noise in self.noises],
        }


def plan_graft(scenario: GraftScenario, seed: int, recorded: Recorded, report: Progress) -> Graft:
    """Split the recording, measure its noise, stand the props and find the rock that moves.

    Raises:
        InputError: The recording cannot be split or read, or is too short to tell its noise.
        ScenarioError: A prop or a rock change finds no place.
    """
    report("measure", 0, 2)
    parts, split = _take_parts(scenario, recorded)
    groups = [parts] if len(recorded.sessions) == 1 else [(part,) for part in parts]
    measured = [measure_noise(group) for group in groups] if scenario.props else []
    noises = [measured[min(number, len(measured) - 1)] for number in range(2)] if measured else []
    report("measure", 1, 2)
    around = Surroundings(parts, scenario.recording.reach_m) if scenario.props or scenario.surface else None
    standing = tuple(stand_props(scenario, around, seed)) if around is not None else ()
    rock = find_rock(scenario, around, standing, seed) if around is not None else ()
    compared = Compared(standing, *(_surfaces(scenario, standing, name) for name in SESSIONS))
    report("measure", 2, 2)
    props = tuple(_props(surfaces) for surfaces in (compared.before, compared.after))
    steps_mm = tuple(measure_step_mm(groups[min(number, len(groups) - 1)]) for number in range(2)) if rock else ()
    told = tuple(noises), standing, tuple(list_changes(scenario, compared)), rock, steps_mm
    return Graft(scenario, seed, recorded, split, parts, (props[0], props[1]), *told)


def _take_parts(scenario: GraftScenario, recorded: Recorded) -> tuple[tuple[Part, Part], str]:
    """Return the two sessions, and how they were made."""
    if len(recorded.sessions) == 2:
        poses = np.eye(4), np.eye(4) if recorded.before_T_after is None else recorded.before_T_after
        before, after = (
            Part(name, session, np.arange(session.n_scans), pose)
            for name, session, pose in zip(SESSIONS, recorded.sessions, poses, strict=True)
        )
        return (before, after), "two recordings"
    (session,) = recorded.sessions
    split = split_scans(session.odom_T_sensor, scenario.recording.split, str(session.path))
    before, after = (
        Part(name, session, scans, np.eye(4)) for name, scans in zip(SESSIONS, (split.before, split.after), strict=True)
    )
    return (before, after), split.name


def _surfaces(scenario: GraftScenario, standing: Sequence[Standing], session: SessionName) -> Surfaces:
    numbers = {prop.name: number for number, prop in enumerate(scenario.props, start=1)}
    here = [item for item in standing if session in item.sessions]
    instance = np.array([numbers[item.prop.name] for item in here], np.int32)
    return Surfaces(tuple(standing_surface(item) for item in here), instance)


def _props(surfaces: Surfaces) -> Props:
    return Props(Caster(surfaces.meshes) if surfaces.meshes else None, surfaces.instance)
