"""Rows of the item tables: one for each change, candidate region and answered object."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from cdpipe.core.geometry import Float64Array
from cdpipe.extract.extract import ASKED_POINTS, FIGURES, hull_volume_m3
from cdpipe.model.report import ChangedObject, ChangeReport
from eval.core.domains import is_change_in_distribution
from eval.scoring.object_metrics import ObjectMatches
from eval.scoring.object_sizes import SizeErrors
from eval.scoring.region_metrics import RegionScores
from eval.scoring.twins import list_twins
from eval.truth.ground_truth import GroundTruth

_NAN = float("nan")


def make_change_rows(
    regions: RegionScores,
    scored: tuple[ObjectMatches, SizeErrors],
    right: Float64Array,
    truth: GroundTruth,
    report: ChangeReport | None,
) -> list[dict[str, Any]]:
    """Return a row of changes.csv for every change, observable or not."""
    rows = []
    (objects, sizes), twins = scored, list_twins(truth)
    for index, change in enumerate(truth.pair.changes):
        fields = {name: value for name, value in asdict(change).items() if name != "world_T_object"}
        matched = int(objects.matched_object[index])
        rows.append(
            {
                **fields,
                "is_found": bool(regions.matches.best_region[index] >= 0),
                "best_region": int(regions.matches.best_region[index]),
                **{name: float(getattr(objects, name)[index]) for name in ("iou_point", "iou_voxel", "iou_box")},
                "matched_object": matched,
                "matched_kind": report.objects[matched].kind if report is not None and matched >= 0 else "",
                "is_kind_right": float(right[index]),
                "displacement_error_m": float(sizes.displacement_m[index]),
                "volume_error_share": float(sizes.volume_share[index]),
                "n_truth_cells": len(truth.change_rows[index]),
                "seen_hull_volume_m3": hull_volume_m3(truth.points_odom(index)),
                "range_m": truth.range_m(index),
                "is_in_distribution": is_change_in_distribution(truth.pair.family, change.prop_kind),
                "twins": ";".join(map(str, twins[index])),
            }
        )
    return rows


def make_region_rows(report: ChangeReport | None, scored: RegionScores, truth: GroundTruth) -> list[dict[str, Any]]:
    """Return a row of regions.csv for every candidate, best first."""
    if report is None:
        return []
    regions = report.regions
    is_withdrawn = regions.is_proposed & ~regions.is_reported
    figures = {name: read_figure(report, name) for name in (*FIGURES, ASKED_POINTS)}
    return [
        {
            "region": index,
            "score": float(regions.scores[index]),
            "is_reported": bool(regions.is_reported[index]),
            "is_withdrawn": bool(is_withdrawn[index]),
            "is_forced": regions.is_forced is not None and bool(regions.is_forced[index]),
            "outcome": scored.matches.outcomes[index],
            **dict(zip(("x_m", "y_m", "z_m"), map(float, regions.centres_map[index]), strict=True)),
            "radius_m": float(regions.radii_m[index]),
            "found_changes": ";".join(str(truth.pair.changes[change].id) for change in scored.matches.found[index]),
            "found_changes_proposed": ";".join(
                str(truth.pair.changes[change].id) for change in scored.proposed.found[index]
            ),
            **{name: float(values[index]) for name, values in figures.items()},
        }
        for index in range(len(regions.scores))
    ]


def make_object_rows(
    objects: tuple[ChangedObject, ...], matches: ObjectMatches, truth: GroundTruth
) -> list[dict[str, Any]]:
    """Return a row of objects.csv for every answered object."""
    rows = []
    for index, (item, outcome) in enumerate(zip(objects, matches.outcomes, strict=True)):
        matched = int(matches.matched_change[index])
        empty = len(item.points_map) == 0
        low, high = (np.full(3, np.nan),) * 2 if empty else (item.points_map.min(axis=0), item.points_map.max(axis=0))
        rows.append(
            {
                "object": index,
                "session": item.session,
                "kind": item.kind,
                "region": item.region,
                "score": float(item.score),
                "n_returns": len(item.returns),
                "n_cells": int(matches.n_cells[index]),
                "matched_change": truth.pair.changes[matched].id if matched >= 0 else -1,
                "iou_point": float(matches.iou_point[matched]) if matched >= 0 else 0.0,
                "outcome": outcome,
                **{f"min_{axis}_m": float(value) for axis, value in zip("xyz", low, strict=True)},
                **{f"max_{axis}_m": float(value) for axis, value in zip("xyz", high, strict=True)},
                "hull_volume_m3": hull_volume_m3(item.points_map),
                "volume_m3": float(item.shape.volume_m3) if item.shape is not None else _NAN,
                "moved_m": float(np.linalg.norm(item.displacement_map)) if item.displacement_map is not None else _NAN,
            }
        )
    return rows


def read_figure(report: ChangeReport, name: str) -> Float64Array:
    """Return (R,) a figure of each region, NaN where the answer does not state it."""
    return np.asarray(report.figures.get(name, np.full(len(report.regions.scores), np.nan)), dtype=np.float64)
