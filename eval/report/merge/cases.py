"""Single merges on the page: their evidence and gates, their outcome and its reason, and the aligned maps."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import invert, travelled_m
from cdpipe.io.answer import read_answer
from cdpipe.io.session import read_session
from cdpipe.merge.evidence import GATES
from cdpipe.model.aligned import alignment_of
from cdpipe.model.alignment import PathAlignment
from eval.report.merge.figures import FULL_M, alignment_picture
from eval.report.tables import Cell, Picture, Table
from eval.running.results.grids import split_variant
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, number, text
from eval.running.runfolder import read_json
from eval.scoring.merge_metrics import PAIR_RADIUS_M
from eval.tables.columns import fine, share, significant
from sim.session.truth import read_true_poses

MAX_ROWS = 40
_ANCHOR_SPACING_M = 1.0
_HEADINGS = (
    "case", *(name.replace("_", " ") for name, _ in GATES), "residual [m]", "true overlap", "error [m]", "error [deg]",
    "along [m]", "p95 along path [m]", "outcome, and why",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Case:
    """One merge: its row of results.csv, the variants that share it, and what its answer says.

    Attributes:
        row: The row of the first of them.
        variants: Their names.
        evidence: What was measured, by name.
        gates: What each piece of evidence had to reach, by its name; {} where nothing was asked, None if not known.
    """

    row: Row
    variants: tuple[str, ...]
    evidence: Mapping[str, float]
    gates: Mapping[str, float] | None

    @property
    def below(self) -> list[str]:
        """Names of the gates that the evidence does not reach."""
        return [name for name, least in (self.gates or {}).items() if not self.evidence.get(name, np.nan) >= least]


def read_case(data: RunData, row: Row, variants: tuple[str, ...] = ()) -> Case:
    """Put a row of results.csv and its answer together."""
    scenario, seed, variant = str(row["scenario"]), int(row["seed"]), str(row["variant"])
    document = read_json(data.folder.answer(scenario, seed, variant) / "answer.json")
    stored = document.get("evidence")
    told = dict(stored) if isinstance(stored, Mapping) else {}
    told |= {name.removeprefix("evidence_"): row[name] for name in row if name.startswith("evidence_")}
    evidence = {name: number(told, name) for name in told}
    evidence = {name: value for name, value in evidence.items() if math.isfinite(value)}
    return Case(row, variants or (variant,), evidence, _gates(document.get("config")))


def distinct_cases(data: RunData, rows: Sequence[Row], preferred: str) -> list[Case]:
    """Return each merge once; variants that differ only in later stages share one, under `preferred` where it can."""
    found: dict[tuple[Any, ...], list[Case]] = {}
    for row in rows:
        case = read_case(data, row)
        measured = tuple(sorted(case.evidence.items()))
        errors = tuple(fine(number(row, name)) for name in ("merge_error_m", "merge_error_deg"))
        key = (row["scenario"], row["seed"], text(row, "status"), text(row, "error"), measured, errors)
        found.setdefault(key, []).append(case)
    chosen: list[Case] = []
    for cases in found.values():
        names = tuple(name for case in cases for name in case.variants)
        speaker = cases[names.index(preferred) if preferred in names else 0]
        chosen.append(replace(speaker, variants=names))
    return chosen


def case_table(cases: Sequence[Case], caption: str, *, by_kind: bool) -> Table:
    """Return one row per merge; what is below its gate is bold, and every gate stands under its value.

    Args:
        cases: The merges.
        caption: What stands above the table.
        by_kind: Name scenario and kind of pair in every row instead of grouping by scenario.
    """
    rows = [("" if by_kind else str(case.row["scenario"]), _cells(case, by_kind=by_kind)) for case in cases]
    return Table(_HEADINGS, tuple(rows), caption)


def outcome_text(case: Case) -> str:
    """Return the outcome of a merge and its reason."""
    status, error = text(case.row, "status"), text(case.row, "error")
    if status != "ok":
        return f"{status.removeprefix('merge_')}: {error}" if error else status.removeprefix("merge_")
    if case.gates is None:
        return "accepted"
    if not case.gates:
        return "accepted; this variant has no gates"
    if case.below:
        return f"accepted although below its gate: {', '.join(name.replace('_', ' ') for name in case.below)}"
    by = " with KISS-Matcher" if case.evidence.get("is_fallback") == 1 else ""
    return f"accepted{by}: all {len(case.gates)} gates are reached"


def draw_case(data: RunData, case: Case, missing: list[str]) -> Picture | None:
    """Draw the aligned maps of a merge coloured by distance; of a refused merge the true alignment, if any."""
    scenario, seed, variant = str(case.row["scenario"]), int(case.row["seed"]), str(case.row["variant"])
    name = f"{scenario}, seed {seed}"
    try:
        before, after_odom = data.folder.read_maps(scenario, seed)
        after = after_odom.astype(np.float64)
        pair = data.folder.pair(scenario, seed)
        if text(case.row, "status") == "ok":
            report = read_answer(data.folder.answer(scenario, seed, variant)).report
            # a rigid merge can be drawn even where the pair is not kept
            is_rigid = report is None or report.local_before_T_after is None
            poses = np.eye(4)[None] if is_rigid else read_session(pair / "after").odom_T_sensor
            alignment = None if report is None else alignment_of(report, poses)
        else:
            alignment = true_alignment(pair)
    except InputError as error:
        missing.append(f"The aligned maps of {name} are not shown: {error}")
        return None
    if alignment is None or len(before) == 0 or len(after) == 0:
        return None
    return Picture(f"{name}: {variant}", alignment_picture(before, alignment.to_map(after)), _caption(case))


def true_alignment(pair: Path) -> PathAlignment | None:
    """Return the true alignment of a pair along the path; None where the sessions never come within 5 m."""
    before, after = (read_session(pair / name).odom_T_sensor for name in ("before", "after"))
    world_T_before, world_T_after = (read_true_poses(pair / name) for name in ("before", "after"))
    along = travelled_m(after)
    scans = np.unique(np.searchsorted(along, np.arange(0.0, along[-1] + _ANCHOR_SPACING_M, _ANCHOR_SPACING_M)))
    scans = scans[scans < len(after)]
    distance_m, nearest = cKDTree(world_T_before[:, :3, 3]).query(world_T_after[scans, :3, 3])
    is_paired = np.asarray(distance_m) <= PAIR_RADIUS_M
    i, j = np.asarray(nearest)[is_paired], scans[is_paired]
    if len(j) == 0:
        return None
    true_i_T_j = invert(world_T_before[i]) @ world_T_after[j]
    return PathAlignment(after[j, :3, 3], before[i] @ true_i_T_j @ invert(after[j]))


def _gates(config: object) -> dict[str, float] | None:
    merge = config.get("merge") if isinstance(config, Mapping) else None
    if not isinstance(merge, Mapping):
        return None
    return {} if merge.get("accept_all") else {name: number(merge, key) for name, key in GATES if key in merge}


def _cells(case: Case, *, by_kind: bool) -> tuple[Cell, ...]:
    row, seed = case.row, int(case.row["seed"])
    names = _presets(case.variants)
    kind = text(row, "pair_kind")
    where = f"{row['scenario']}, {seed}" if by_kind else f"seed {seed}"
    return (
        Cell(where, interval=", ".join(word for word in (kind, "" if by_kind else names) if word)),
        *(_gate_cell(case, name) for name, _ in GATES),
        Cell(fine(case.evidence.get("residual_m", np.nan))),
        Cell(share(number(row, "overlap_true"))),
        *(Cell(fine(number(row, f"merge_error_{name}"))) for name in ("m", "deg", "along_m", "m_p95")),
        Cell(outcome_text(case)),
    )


def _gate_cell(case: Case, name: str) -> Cell:
    value = case.evidence.get(name, np.nan)
    least = (case.gates or {}).get(name)
    gate = "" if least is None else f"≥ {least:g}"
    return Cell(significant(float(value)), name in case.below and not math.isnan(value), gate)


def _presets(variants: Sequence[str]) -> str:
    counts = Counter(split_variant(name)[0] for name in variants)
    return ", ".join(name if n == 1 else f"{name} ({n} settings)" for name, n in counts.items())


def _caption(case: Case) -> str:
    row, kind = case.row, text(case.row, "pair_kind")
    kind_words = f"A {kind} pair" if kind else "A pair"
    colours = (
        f"Colour: how far the after map lies from the surface of the before map, up to {FULL_M:g} m, farthest points "
        "on top; grey: before map alone."
    )
    if text(row, "status") != "ok":
        return f"{kind_words} that was refused, drawn as the maps truly lie. {colours}"
    metres, degrees = number(row, "merge_error_m"), number(row, "merge_error_deg")
    if np.isnan(metres):
        return f"{kind_words}, accepted; its error is undefined: the sessions share no place. {colours}"
    error = f"median error {fine(metres)} m and {fine(degrees)} deg, {fine(number(row, 'merge_error_along_m'))} m along"
    return f"{kind_words}, accepted: {error} the tunnel. {colours}"
