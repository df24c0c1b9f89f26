"""Scores of a displacement field: errors, cover, levels of detection, surface changes found, and their volumes.

All figures are over the places that the harness chose (`eval.scoring.surface.places`). A place that an answer leaves
out counts as displacement 0, so leaving out the difficult places gains nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cdpipe.io.answer import Answer
from cdpipe.model.report import SurfaceField
from eval.core.statistics import mean, median
from eval.scoring.surface.places import (
    SurfaceAnswer,
    SurfacePlaces,
    carry_surface,
    find_surface_places,
    mark_true_regions,
)
from eval.scoring.surface.windows import list_windows
from eval.truth.ground_truth import GroundTruth
from sim.session.truth import SurfaceChangeTruth

SURFACE_GROUP = "surface"
MIN_CORE_PLACES = 8
CORE_SHARE = 0.5
FOUND_SHARE = 0.5
VOLUME_KINDS = ("scar", "rubble")
_NAN = float("nan")
_ERRORS = tuple(
    f"surface_{name}{part}"
    for name in ("cover", "error_median", "error_p95", "bias")
    for part in (("", "_changed", "_unchanged") if name == "cover" else ("_m", "_changed_m", "_unchanged_m"))
)
COLUMNS = (
    *_ERRORS, "surface_level_inside", "surface_level_median_m", "surface_recall", "surface_region_precision",
    "surface_false_regions_per_100m", "surface_volume_error_share", "n_surface_places", "n_surface_changes",
    "n_surface_regions", "t_surface_s",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceScores:
    """Scores of one answer's displacement field.

    Attributes:
        columns: Its columns of results.csv.
        changes: A row of surface_changes.csv for each surface change of the truth.
        windows: A row of surface_windows.csv for each window.
    """

    columns: dict[str, float]
    changes: list[dict[str, Any]] = field(default_factory=list)
    windows: list[dict[str, Any]] = field(default_factory=list)


def is_surface_pair(truth: GroundTruth) -> bool:
    """Tell whether a pair asks for a displacement field: rock moved in it, or its family is one of `surface/...`."""
    return bool(truth.pair.surface_changes) or truth.pair.family.partition("/")[0] == SURFACE_GROUP


def score_surface(answer: Answer, truth: GroundTruth, after_path_m: float) -> SurfaceScores:
    """Score the displacement field of an answer.

    A pair that asks for a field is scored as an empty field where the answer has none, or where there is no answer. On
    any other pair an answer without a field has no columns and no rows, so that the tables of a run in which no rock
    moves stay as they were. So has an answer that ends at the merge.

    Args:
        answer: The answer, checked.
        truth: The pair's truth.
        after_path_m: Path length of the after session, metres.
    """
    surface = None if answer.report is None else answer.report.surface
    if answer.until is not None or (surface is None and not is_surface_pair(truth)):
        return SurfaceScores({})
    places = find_surface_places(truth)
    said = carry_surface(surface, places)
    changes = [_score_change(each, surface, said, places) for each in truth.pair.surface_changes]
    is_true = np.zeros(0, dtype=np.bool_) if surface is None else mark_true_regions(surface, places)
    n_false = int(np.count_nonzero(~is_true))
    is_rated = answer.report is not None and after_path_m > 0
    is_in_region = places.is_judged & (said.region >= 0)
    asked = [row for row in changes if row["is_observable"]]
    nothing = 0.0 if asked else _NAN
    columns = {
        **_measure_errors(said, places),
        **_measure_levels(said, places),
        "surface_recall": mean(np.array([row["is_found"] for row in asked], dtype=np.float64)),
        "surface_region_precision": float(places.is_changed[is_in_region].mean()) if is_in_region.any() else nothing,
        "surface_false_regions_per_100m": 100.0 * n_false / after_path_m if is_rated else _NAN,
        "surface_volume_error_share": mean(
            np.array([min(row["volume_error_share"], 1.0) for row in asked if row["kind"] in VOLUME_KINDS])
        ),
        "n_surface_places": int(np.count_nonzero(places.is_judged)),
        "n_surface_changes": len(asked) if is_surface_pair(truth) else _NAN,
        "n_surface_regions": len(is_true),
        "t_surface_s": float(answer.seconds.get("t_surface_s", _NAN)),
    }
    return SurfaceScores(columns, changes, list_windows(said, places))


def _measure_errors(said: SurfaceAnswer, places: SurfacePlaces) -> dict[str, float]:
    error_m = said.answered_m - places.true_m
    outward_m = error_m * np.where(places.is_changed, np.sign(places.true_m), 1.0)
    found: dict[str, float] = {}
    for part, is_part, signed_m in (
        ("", places.is_judged, error_m),
        ("_changed", places.is_judged & places.is_changed, outward_m),
        ("_unchanged", places.is_judged & ~places.is_changed, error_m),
    ):
        size_m = np.abs(error_m[is_part])
        found[f"surface_cover{part}"] = mean(said.is_covered[is_part].astype(np.float64))
        found[f"surface_error_median{part}_m"] = median(size_m)
        found[f"surface_error_p95{part}_m"] = float(np.percentile(size_m, 95)) if len(size_m) else _NAN
        found[f"surface_bias{part}_m"] = mean(signed_m[is_part])
    return {name: found[name] for name in _ERRORS}


def _measure_levels(said: SurfaceAnswer, places: SurfacePlaces) -> dict[str, float]:
    """Return the share of unchanged places inside their level; a place without a level is not inside."""
    is_asked = places.is_judged & ~places.is_changed
    is_answered = is_asked & said.is_covered
    is_inside = np.abs(said.answered_m) <= np.nan_to_num(said.level_m, nan=-1.0)
    nothing = 0.0 if is_asked.any() else _NAN
    return {
        "surface_level_inside": float(is_inside[is_answered].mean()) if is_answered.any() else nothing,
        "surface_level_median_m": median(said.level_m[is_answered]),
    }


def _score_change(
    change: SurfaceChangeTruth, surface: SurfaceField | None, said: SurfaceAnswer, places: SurfacePlaces
) -> dict[str, Any]:
    """Return the row of one surface change."""
    is_its = places.is_judged & (places.change == change.id) & places.is_changed
    size_m = np.abs(places.true_m)
    is_core = is_its & (size_m >= CORE_SHARE * size_m[is_its].max(initial=0.0))
    sign = np.sign(change.largest_m)
    is_claimed = (said.region >= 0) & (np.sign(said.answered_m) == np.sign(places.true_m))
    n_core = int(np.count_nonzero(is_core))
    share = mean(is_claimed[is_core].astype(np.float64))
    is_observable = n_core >= MIN_CORE_PLACES
    volume_m3 = 0.0 if surface is None else _answered_volume(surface, said, places, change.id, sign)
    return {
        "surface_change": change.id,
        "name": change.name,
        "kind": change.kind,
        "partner": -1 if change.partner is None else change.partner,
        "area_m2": change.area_m2,
        "volume_m3": change.volume_m3,
        "largest_m": change.largest_m,
        "mean_m": change.mean_m,
        "n_places": int(np.count_nonzero(is_its)),
        "n_core_places": n_core,
        "is_observable": is_observable,
        "is_found": bool(is_observable and share >= FOUND_SHARE),
        "found_share": share,
        "cover": mean(said.is_covered[is_its].astype(np.float64)),
        "true_places_m": mean(places.true_m[is_its]),
        "answered_places_m": mean(said.answered_m[is_its]),
        "answered_volume_m3": volume_m3,
        "volume_error_share": abs(volume_m3 - change.volume_m3) / abs(change.volume_m3) if change.volume_m3 else _NAN,
    }


def _answered_volume(
    surface: SurfaceField, said: SurfaceAnswer, places: SurfacePlaces, change: int, sign: float
) -> float:
    """Return the summed volume of the regions of one sign that hold more places of this change than of any other.

    Of changes of that sign with equally many the first has the region.
    """
    total_m3 = 0.0
    is_held = places.is_judged & places.is_changed & (said.region >= 0)
    for region in np.unique(said.region[is_held & (places.change == change)]):
        n_of_change = np.bincount(places.change[is_held & (said.region == region)])
        # changed places of no change belong to nobody
        n_of_change[0] = 0
        volume_m3 = surface.regions[region].volume_m3
        equals = np.flatnonzero(n_of_change == n_of_change.max())
        suits = [each for each in equals if np.sign(places.true_m[is_held & (places.change == each)].sum()) == sign]
        if change in suits[:1] and np.sign(volume_m3) == sign:
            total_m3 += volume_m3
    return total_m3
