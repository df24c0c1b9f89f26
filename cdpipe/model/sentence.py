"""The sentence of an answer: what changed, and how much of the way was compared."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from cdpipe.model.types import Kind

if TYPE_CHECKING:
    from cdpipe.model.report import ChangedObject, ChangeReport, Coverage

_KINDS: tuple[Kind, ...] = ("added", "moved", "removed", "reshaped")
# A shorter before path is one place.
_PLACE_M = 0.5


def tell(report: ChangeReport) -> str:
    """Return one sentence about an answer, e.g. `5 added, 1 moved 2.3 m, 2 removed; 410 m compared, 35 m not seen`.

    A moved object counts once, though both its places are objects of the report. Without objects, the reported regions
    are counted. Rock that moved is told where it was measured, the compared way where it is known. A report without any
    says that no change was found, and not that there is none.
    """
    told = [*_tell_objects(report), *_tell_rock(report)]
    way = [] if report.coverage is None else [_tell_coverage(report.coverage)]
    return "; ".join([", ".join(told) or _tell_nothing(report), *way])


def moved_m(item: ChangedObject, objects: tuple[ChangedObject, ...]) -> float:
    """Return how far an object moved, metres: its displacement, else the way between the means of both its places.

    NaN if it has no partner, or the report does not hold the points.
    """
    both = [item, *([objects[item.partner]] if 0 <= item.partner < len(objects) else [])]
    for each in both:
        if each.displacement_map is not None:
            return float(np.linalg.norm(each.displacement_map))
    places = [each.points_map.mean(axis=0) for each in both if len(each.points_map)]
    return float(np.linalg.norm(places[0] - places[1])) if len(places) == 2 else float("nan")


def _tell_objects(report: ChangeReport) -> Iterator[str]:
    objects = report.objects
    for kind in _KINDS:
        # both places of a moved object have the same two indices
        own = {
            frozenset((index, item.partner)) if kind == "moved" and item.partner >= 0 else index: item
            for index, item in enumerate(objects)
            if item.kind == kind
        }
        ways_m = [moved_m(item, objects) for item in own.values() if kind == "moved"]
        if own:
            yield f"{len(own)} {kind}{_tell_ways([way_m for way_m in ways_m if np.isfinite(way_m)])}"
    n_regions = int(report.regions.is_reported.sum())
    if not objects and n_regions:
        yield f"{n_regions} changed region{'s' if n_regions > 1 else ''}"


def _tell_ways(ways_m: list[float]) -> str:
    if not ways_m:
        return ""
    low, high = f"{min(ways_m):.1f}", f"{max(ways_m):.1f}"
    return f" {high} m" if low == high else f" {low} to {high} m"


def _tell_rock(report: ChangeReport) -> Iterator[str]:
    regions = () if report.surface is None else report.surface.regions
    if regions:
        largest_mm = 1000 * max((item.largest_m for item in regions), key=abs)
        places = "place" if len(regions) == 1 else "places"
        yield f"rock moved at {len(regions)} {places} by up to {abs(largest_mm):.0f} mm"


def _tell_nothing(report: ChangeReport) -> str:
    """Return that no change was found, and how many regions were looked at and withdrawn."""
    n_withdrawn = 0 if report.regions.is_withdrawn is None else int(report.regions.is_withdrawn.sum())
    looked = f" in {n_withdrawn} region{'s' if n_withdrawn > 1 else ''} looked at" if n_withdrawn else ""
    return f"no change found{looked}"


def _tell_coverage(coverage: Coverage) -> str:
    if coverage.compared_m + coverage.unseen_m < _PLACE_M:
        return "one place compared" if coverage.is_near.any() else "one place not seen"
    return f"{coverage.compared_m:.0f} m compared, {coverage.unseen_m:.0f} m not seen"
