"""The figures of a survey as a table: one row per seed in a file, one row per family to read."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from sim.studies.survey import Survey, WorldFigures

_KINDS = ("added", "removed", "moved", "reshaped")


def write_csv(path: Path, surveys: Sequence[Survey]) -> None:
    """Write one row per seed, failures with their reason; lists are written as their smallest, median and largest.

    Raises:
        InputError: The file cannot be written.
    """
    rows = [_csv_row(world) for one in surveys for world in one.worlds]
    rows += [
        {"family": lost.family, "seed": lost.seed, "failure": lost.reason} for one in surveys for lost in one.failures
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    try:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, [*(name for name in names if name != "failure"), "failure"])
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error


def summary(one: Survey) -> dict[str, str]:
    """Return a family's row of the table: column to text, "-" where nothing was measured."""
    worlds = one.worlds
    n_seeds = len(worlds) + len(one.failures)
    kinds = {kind: sum(getattr(world, f"n_{kind}") for world in worlds) for kind in _KINDS}
    counts = [float(world.n_changes) for world in worlds]
    hulls = [volume for world in worlds for volume in world.hull_m3]
    deepest = [1000 * world.interpenetration_m for world in worlds]
    return {
        "family": one.family,
        "worlds": f"{len(worlds)} of {n_seeds}",
        "path before, m": _range([world.before_path_m for world in worlds], ".0f"),
        "path after, m": _range([world.after_path_m for world in worlds], ".0f"),
        "width, m": _range([world.width_m for world in worlds], ".1f"),
        "height, m": _range([world.height_m for world in worlds], ".1f"),
        "changes": _range(counts, ".0f"),
        "added, removed, moved, reshaped": ", ".join(str(kinds[kind]) for kind in _KINDS),
        "hull, m3": _range(hulls, ".2f"),
        "distractors per 100 m": _range([world.distractors_per_100m for world in worlds], ".1f"),
        "far keyframes": _mean_and_least([world.far_share for world in worlds]),
        "repose, deg": _range([angle for world in worlds for angle in world.repose_deg], ".1f"),
        "roughness, m": _range([world.roughness_m for world in worlds], ".3f"),
        "deepest in rock, mm": f"{max(deepest):.1f}" if deepest else "-",
        "triangles, 1000": _range([world.n_triangles / 1000 for world in worlds], ".0f"),
        "build, CPU s": _range([world.build_s for world in worlds], ".1f"),
    }


def markdown(surveys: Sequence[Survey]) -> str:
    """Return the table of some families in Markdown, one row each; three figures are least - median - largest."""
    rows = [summary(one) for one in surveys]
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([f"`{row['family']}`", *list(row.values())[1:]] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _csv_row(world: WorldFigures) -> dict[str, object]:
    row: dict[str, object] = {}
    for name in (each.name for each in fields(world)):
        value = getattr(world, name)
        if not isinstance(value, tuple):
            row[name] = value
            continue
        spread = (min(value), float(np.median(value)), max(value)) if value else ("", "", "")
        row |= dict(zip((f"{name}_min", f"{name}_median", f"{name}_max"), spread, strict=True))
    return row


def _range(values: Sequence[float], form: str) -> str:
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return "-"
    return " - ".join(format(value, form) for value in (min(known), float(np.median(known)), max(known)))


def _mean_and_least(shares: Sequence[float]) -> str:
    return f"{100 * np.mean(shares):.0f} %, least {100 * min(shares):.0f} %" if shares else "-"
