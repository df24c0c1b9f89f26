"""A pair of sessions from real recordings, with props cast into them, rock moved, and their exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float32Array, invert, transform
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.io.session import ScanChunk, SessionWriter, fit_chunk
from scenarios.grafted import GraftScenario
from sim.graft.casting import Grafted, graft_revolution
from sim.graft.part import Part, RecordedRevolution
from sim.graft.plan import Graft, Recorded, plan_graft
from sim.graft.rock import RockCounts, move_rock
from sim.session.labels import mark_belonging
from sim.session.simulate import HeldPair, HeldSession, LabelledSession
from sim.session.truth import (
    Int16Array,
    PairTruth,
    write_labels,
    write_pair_truth,
    write_surface_labels,
    write_true_poses,
)

Surface = tuple[Float32Array, Int16Array]
"""Displacement and surface change of each return, as in `sim.session.truth`."""


@dataclass(slots=True, eq=False)
class Counts:
    """What grafting changed in a session: recorded returns that are gone, returns of props, lost beams, moved rock."""

    rock: RockCounts
    replaced: int = 0
    grafted: int = 0
    lost: int = 0

    def add(self, made: Grafted) -> None:
        """Count a revolution."""
        self.replaced += made.n_replaced
        self.grafted += int(np.count_nonzero(made.instance > 0))
        self.lost += made.n_lost


def graft_pair(
    scenario: GraftScenario,
    seed: int,
    recorded: Recorded,
    files: Mapping[str, str],
    out: Path,
    report: Progress = report_nothing,
) -> PairTruth:
    """Write `before`, `after` and `truth` of a grafted pair into an empty folder, as `simulate_pair` does.

    The same recordings, scenario and seed give the same bytes. A return that no prop touches, and that does not lie on
    rock that moves, keeps its bytes.

    Args:
        scenario: The props and the rock that moves, drawn.
        seed: Draws places, noise and lost beams.
        recorded: The recordings.
        files: Digests of the files of the scenario.
        out: The folder.
        report: Called with the stage, and how much of how much is done.

    Raises:
        InputError: A recording cannot be split or read, or nothing can be written.
        ScenarioError: A prop or a rock change finds no place.
    """
    graft = plan_graft(scenario, seed, recorded, report)
    try:
        counts = [_write_session(graft, number, out, report) for number in range(2)]
        truth = collect_truth(graft, files, counts)
        write_pair_truth(out, truth)
    except OSError as error:
        raise InputError(f"{out}: cannot write there: {error.strerror or error}") from error
    return truth


def graft_in_memory(scenario: GraftScenario, seed: int, recorded: Recorded, files: Mapping[str, str]) -> HeldPair:
    """Graft a pair into memory; the arrays equal, to the byte, those that `graft_pair` writes.

    Raises:
        InputError, ScenarioError: As `graft_pair`.
    """
    graft = plan_graft(scenario, seed, recorded, report_nothing)
    counts = [_no_counts(graft) for _ in graft.parts]
    sessions = {part.name: _hold_session(graft, number, counts[number]) for number, part in enumerate(graft.parts)}
    return HeldPair(collect_truth(graft, files, counts), sessions)


def collect_truth(graft: Graft, files: Mapping[str, str], counts: list[Counts]) -> PairTruth:
    """Return the truth of a pair after both sessions were grafted."""
    scenario, changes = graft.scenario, tuple(tally.finished() for tally in graft.tallies)
    returns = [{"replaced": each.replaced, "grafted": each.grafted, "lost": each.lost} for each in counts]
    drawn = scenario.family, graft.seed, scenario.score_radius_m, changes, scenario.model_dump(mode="json")
    told = {**graft.describe(), "returns": returns}
    if graft.rock:
        moved, left = ([getattr(each.rock, name).tolist() for each in counts] for name in ("moved", "left"))
        each = zip(graft.rock, zip(*moved, strict=True), zip(*left, strict=True), strict=True)
        told["rock"] = [{**patch.as_plain(), "moved": of_moved, "left": of_left} for patch, of_moved, of_left in each]
    surface = tuple(patch.describe() for patch in graft.rock)
    return PairTruth(*drawn, dict(files), surface_changes=surface, graft=told)


def _no_counts(graft: Graft) -> Counts:
    n = len(graft.rock)
    return Counts(RockCounts(np.zeros(n, np.int64), np.zeros(n, np.int64)))


def _write_session(graft: Graft, number: int, out: Path, report: Progress) -> Counts:
    part, counts = graft.parts[number], _no_counts(graft)
    source, n_scans = part.source, len(part.scans)
    told = source.sensor, _chunk_scans(part), _provenance(graft, part), source.n_returns
    with SessionWriter(out / part.name, *told) as writer:
        done = 0
        for index, (chunk, instance, change, surface) in enumerate(_fill_chunks(graft, number, counts)):
            writer.add(chunk)
            write_labels(writer.folder, index, instance, change)
            if surface is not None:
                write_surface_labels(writer.folder, index, *surface)
            done += len(instance)
            report(part.name, done, n_scans)
        write_true_poses(writer.folder, part.world_T_sensor)
        writer.close(part.odom_T_sensor)
    return counts


def _hold_session(graft: Graft, number: int, counts: Counts) -> LabelledSession:
    part = graft.parts[number]
    chunks, instance, change, surface = zip(*_fill_chunks(graft, number, counts), strict=True)
    session = HeldSession(
        Path(part.name),
        part.source.sensor,
        part.odom_T_sensor,
        _chunk_scans(part),
        _provenance(graft, part),
        chunks,
        n_returns=part.source.n_returns,
    )
    labels = part.world_T_sensor, np.concatenate(instance), np.concatenate(change)
    moved = [each for each in surface if each is not None]
    return LabelledSession(session, *labels, *(np.concatenate(each) for each in zip(*moved, strict=True)))


def _provenance(graft: Graft, part: Part) -> dict[str, object]:
    """Return what a session tells of itself; nothing of what was grafted."""
    told: dict[str, object] = {"made_by": "tunnelcd graft", "session": part.name}
    told |= {"recording": part.source.path.name, "split": graft.split}
    start_ns = part.source.provenance.get("sensor_clock_start_ns")
    return told if start_ns is None else {**told, "sensor_clock_start_ns": start_ns}


def _chunk_scans(part: Part) -> int:
    return fit_chunk(part.source.rows, part.source.sensor.width)


def _fill_chunks(
    graft: Graft, number: int, counts: Counts
) -> Iterator[tuple[ScanChunk, Int16Array, Int16Array, Surface | None]]:
    """Yield the chunks of a session with instance and change of each return; tallies and counts fill meanwhile.

    Where rock moves, displacement and surface change come with them.
    """
    revolutions = _graft_revolutions(graft, number, counts)
    while batch := list(islice(revolutions, _chunk_scans(graft.parts[number]))):
        chunk = ScanChunk(
            np.stack([made.range_mm for _, made, *_ in batch]),
            np.stack([made.reflectivity for _, made, *_ in batch]),
            np.stack([made.signal for _, made, *_ in batch]),
            np.stack([recorded.column_stamps_ns for recorded, *_ in batch]),
            np.stack([recorded.column_poses for recorded, *_ in batch]),
        )
        instance, change = np.stack([made.instance for _, made, *_ in batch]), np.stack([each[2] for each in batch])
        moved = [surface for *_, surface in batch if surface is not None]
        surface = (np.stack([each[0] for each in moved]), np.stack([each[1] for each in moved])) if moved else None
        yield chunk, instance, change, surface


def _graft_revolutions(
    graft: Graft, number: int, counts: Counts
) -> Iterator[tuple[RecordedRevolution, Grafted, Int16Array, Surface | None]]:
    part, props = graft.parts[number], graft.props[number]
    noise = graft.noises[number] if graft.noises else None
    for recorded in part.revolutions():
        revolution, truth = recorded, None
        if graft.rock:
            revolution, truth = move_rock(part, recorded, graft.rock, graft.steps_mm[number], counts.rock, graft.seed)
        made = graft_revolution(part, revolution, props, noise, graft.seed)
        counts.add(made)
        surface = None if truth is None else truth.on_rock(made.instance == 0)
        yield revolution, made, _tally(graft, part, made), surface


def _tally(graft: Graft, part: Part, made: Grafted) -> Int16Array:
    """Add a revolution to the tallies of the changes, and return the change (R, W) that each return belongs to."""
    height = part.source.sensor.height
    change = np.zeros(made.range_mm.shape, np.int16)
    farthest_m = made.reach_m.reshape(-1, height, made.reach_m.shape[1]).max(axis=0).astype(np.float32)
    odom_T_world = invert(part.world_T_odom)
    for tally in graft.tallies:
        is_own = tally.change.session == part.name
        if not is_own:
            tally.n_ghost_rays += tally.ghost.count(made.rays, farthest_m.T)
        row, column = np.nonzero(made.instance == tally.change.instance)
        if is_own and len(row):
            belongs = mark_belonging(tally, made.rays.points(row % height, column, made.reach_m[row, column]))
            row, column = row[belongs], column[belongs]
            change[row, column] = tally.change.id
        if len(row):
            measured_m = made.range_mm[row, column] / 1000.0 - part.source.sensor.beam_origin_m
            points = made.rays.points(row % height, column, measured_m)
            (tally.own if is_own else tally.other).add(transform(odom_T_world, points))
    return change
