"""Checks of a whole scenario: the files it names, and contradictions between its values."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files import Key, require_plain_file
from cdpipe.sensor.ouster import load_profile
from scenarios.dangling import Mistake, items_at, mapping_at
from scenarios.grafted import GraftScenario
from scenarios.schema import Furniture, Platform, Scenario, Section, Sensor, SessionPlan, Tunnel

_BESIDE = frozenset({"truth", "descriptors"})


def file_keys(tree: Any) -> list[tuple[Key, str]]:
    """Return every file that a drawn scenario names, as (key path, name)."""
    places: list[tuple[Key, Any]] = [(("tunnel", "mesh"), mapping_at(mapping_at(tree, "tunnel"), "mesh").get("path"))]
    places += [
        (("props", index, "mesh"), mapping_at(prop, "mesh").get("path"))
        for index, prop in enumerate(items_at(tree, "props"))
    ]
    files = [((*key, "path"), name) for key, name in places]
    files += [((session, "trajectory"), mapping_at(tree, session).get("trajectory")) for session in ("before", "after")]
    files += [
        ((session, "odometry", "file"), mapping_at(mapping_at(tree, session), "odometry").get("file"))
        for session in ("before", "after")
    ]
    files += list(_recording_keys(mapping_at(tree, "recording")))
    owners: dict[Key, Any] = {(): tree, **{(name,): mapping_at(tree, name) for name in ("before", "after")}}
    for owner, holder in owners.items():
        profile = mapping_at(holder, "sensor").get("profile")
        # else a shipped one's name
        files += [((*owner, "sensor", "profile"), profile)] if str(profile).endswith(".json") else []
    return [(key, name) for key, name in files if isinstance(name, str)]


def _recording_keys(recording: Mapping[str, Any]) -> Iterator[tuple[Key, Any]]:
    """Yield the files of a recording that props are grafted into."""
    for name in ("sessions", "trajectories", "metadata"):
        yield from ((("recording", name, index), file) for index, file in enumerate(items_at(recording, name)))
    yield ("recording", "before_T_after"), recording.get("before_T_after")


def file_digests(scenario: Scenario) -> dict[str, str]:
    """Return the SHA-256 of every file that a drawn scenario names, by its path as seen from the working folder.

    Raises:
        InputError: One of them cannot be read.
    """
    found: dict[str, str] = {}
    for _, name in file_keys(scenario.model_dump(mode="json")):
        try:
            found[name] = _digest(Path(name))
        except OSError as error:
            raise InputError(f"{name}: cannot be read: {error.strerror}") from error
    return found


def without_paths(drawn: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
    """Return a drawn scenario as a plain tree with the digest of each file in place of its path.

    It is the same from every working folder and on every machine.

    Args:
        drawn: The scenario, `model_dump(mode="json")`.
        files: As `file_digests` returns them.
    """
    tree = copy.deepcopy(dict(drawn))
    for key, name in file_keys(tree):
        holder: Any = tree
        for part in key[:-1]:
            holder = holder[part]
        holder[key[-1]] = files.get(name, name)
    return tree


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; of a folder, which is a recording, of the names and digests of its files."""
    if not path.is_dir():
        require_plain_file(path)
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    # the truth of a simulated one, and what `tunnelcd describe` leaves, are not recorded
    kept = (each for each in path.rglob("*") if _BESIDE.isdisjoint(each.relative_to(path).parts))
    files = sorted(each for each in kept if each.is_file())
    told = "\n".join(f"{each.relative_to(path).as_posix()} {_digest(each)}" for each in files)
    return hashlib.sha256(told.encode()).hexdigest()


def route_length_m(tunnel: Tunnel, plan: SessionPlan) -> float:
    """Return the length of a session's route along the straight lines between its nodes, start_m and end_m left out."""
    path_m = sum(math.dist(tunnel.nodes[first], tunnel.nodes[second]) for first, second in pairwise(plan.route))
    return path_m - plan.start_m - plan.end_m


def find_contradictions(scenario: Scenario) -> list[Mistake]:
    """Return what cannot be built or driven in a scenario whose references hold, as (key path, rule)."""
    if isinstance(scenario, GraftScenario):
        return []
    return [
        *_foreign_mistakes(scenario),
        *_undrawable(scenario),
        *_start_mistakes(scenario),
        *_room_mistakes(scenario),
        *_sensor_mistakes(scenario),
    ]


def _start_mistakes(scenario: Scenario) -> Iterator[Mistake]:
    for name, plan in (("before", scenario.before), ("after", scenario.after)):
        if plan.trajectory is not None:
            continue
        left_m = route_length_m(scenario.tunnel, plan)
        if left_m <= 0:
            whole_m = left_m + plan.start_m + plan.end_m
            yield (name, "start_m"), f"start_m and end_m leave nothing of the route, which is {whole_m:.1f} m"
        elif left_m < scenario.of(name).platform.scan_spacing_m:
            owner: Key = (name, "platform") if plan.platform else ("platform",)
            yield (*owner, "scan_spacing_m"), f"is longer than {name}'s route, {left_m:.1f} m without start_m and end_m"


def _room_mistakes(scenario: Scenario) -> Iterator[Mistake]:
    """Yield what a platform has no room for in the drifts that its session's route leads through."""
    section_of: dict[frozenset[str], Section] = {}
    for drift in scenario.tunnel.drifts:
        for pair in pairwise(drift.nodes):
            section_of.setdefault(frozenset(pair), drift.section or scenario.tunnel.section)
    told: set[Key] = set()
    for name, plan in (("before", scenario.before), ("after", scenario.after)):
        if not plan.route:
            continue
        driven = [section_of[frozenset(pair)] for pair in pairwise(plan.route)]
        width_m = min(section.width_m for section in driven)
        roof_m = min(section.height_m for section in driven)
        platform: Platform = plan.platform or scenario.platform
        owner: Key = (name, "platform") if plan.platform else ("platform",)
        if width_m <= 2 * platform.clearance_m and owner not in told:
            told.add(owner)
            yield (*owner, "clearance_m"), f"leaves the platform no room in a drift {width_m:.1f} m wide"
        if (plan.height_m or platform.sensor_height_m) >= roof_m:
            key: Key = (name, "height_m") if plan.height_m else (*owner, "sensor_height_m")
            yield key, f"the sensor would be above the roof of a drift {roof_m:.1f} m high"


def _sensor_mistakes(scenario: Scenario) -> Iterator[Mistake]:
    owners: dict[Key, Sensor | None] = {
        (): scenario.sensor, ("before",): scenario.before.sensor, ("after",): scenario.after.sensor
    }  # fmt: skip
    for owner, sensor in owners.items():
        if sensor is None or (sensor.profile.endswith(".json") and not Path(sensor.profile).is_file()):
            continue  # a missing file is reported already
        key: Key = (*owner, "sensor", "profile")
        try:
            load_profile(sensor.profile)
            key = (*owner, "sensor", "mode")
            load_profile(sensor.profile, sensor.mode)
        except InputError as error:
            yield key, str(error)


def _foreign_mistakes(scenario: Scenario) -> Iterator[Mistake]:
    """Yield settings that do not apply to walls from a file, or that need drifts along them."""
    tunnel = scenario.tunnel
    if tunnel.mesh is None:
        return
    shaping: list[tuple[Key, bool]] = [
        (("niches",), bool(tunnel.niches)),
        (("variation",), tunnel.variation is not None),
        (("roughness",), any(octave.amplitude_m for octave in tunnel.roughness)),
        (("meander_m",), tunnel.meander_m > 0),
        (("floor", "crossfall_percent"), tunnel.floor.crossfall_percent != 0),
        (("floor", "ruts"), tunnel.floor.ruts is not None),
    ]
    for key, is_given in shaping:
        if is_given:
            yield ("tunnel", *key), "shapes drifts, and tunnel.mesh is not shaped: leave it out"
    if tunnel.drifts:
        return
    if tunnel.furniture != Furniture():
        yield ("tunnel", "furniture"), "hangs along drifts: give tunnel.drifts that run through tunnel.mesh"
    if tunnel.floor.stones is not None:
        yield ("tunnel", "floor", "stones"), "lie along drifts: give tunnel.drifts that run through tunnel.mesh"
    if scenario.surface:
        yield ("surface",), "rock changes along drifts: give tunnel.drifts that run through tunnel.mesh"


def _undrawable(scenario: Scenario) -> Iterator[Mistake]:
    """Yield places that the seed cannot draw, because a session has a trajectory and no route."""
    without = [name for name, plan in (("before", scenario.before), ("after", scenario.after)) if not plan.route]
    if not without:
        return
    needs = f"needs a route in both sessions, and {without[0]} has a trajectory"
    if scenario.areas:
        yield ("areas",), f"an area {needs}"
    for index, prop in enumerate(scenario.props):
        for name, place in (("place", prop.place), ("to", prop.to)):
            if place is not None and place.between is None and place.at is None and place.area is None:
                yield ("props", index, name), f"a place anywhere {needs}: give at, or between and fraction"
    for index, mover in enumerate(scenario.movers):
        if mover.path.between is None and mover.path.area is None:
            yield ("movers", index, "path"), f"a path anywhere {needs}: give between and fractions"
    for index, puddle in enumerate(scenario.puddles):
        if puddle.place.between is None and puddle.place.area is None:
            yield ("puddles", index, "place"), f"a place anywhere {needs}: give between and fraction"
