"""The layers of an answer's page: named points and lines of one colour, and how the page stores them."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.geometry.voxel import FINEST_CELL_M, thin
from cdpipe.model.report import SurfaceField
from eval.report.answer.content import AnswerContent, near_stretches
from eval.report.answer.shapes import AFTER_RGB, BEFORE_RGB, REGION_RGB, WRONG_RGB, roof_mask, sphere_path
from sim.view.returns import CHANGE_RGB, Rgb
from sim.view.rock import ROCK_RGB, class_name, displacement_class

_LINE_M, OBJECT_POINT_M, _ROCK_POINT_M = 0.05, 0.09, 0.12
# Edge of a point of a map, as a share of the cell that holds one.
_FILLED = 0.8
# Cell of the points of objects and of rock; that of rock grows until no more points are left.
_OBJECT_CELL_M, _ROCK_CELL_M, _LARGER, _MAX_ROCK = FINEST_CELL_M, 0.1, 1.25, 50_000
_LARGEST, _MAX_PATH = 65_535, 20_000
MOVED_ROCK, ELSEWHERE = "rock that moved", "displacement elsewhere"


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Points, or a line through them, in one colour; the group, e.g. `map before`, is shown or hidden as a whole.

    Attributes:
        group: What its switch says.
        kind: How it is drawn.
        points: (N, 3) places, map frame, metres.
        rgb: Its colour.
        size_m: Edge of a point, metres.
        is_shown: Whether it is visible at first.
        name: What a picture or legend of single layers calls it, "" for its group.
    """

    group: str
    kind: Literal["points", "line"]
    points: Float64Array
    rgb: Rgb
    size_m: float = _LINE_M
    is_shown: bool = True
    name: str = ""


def list_layers(content: AnswerContent) -> list[Layer]:
    """Return all layers that hold points: maps and roofs first, then rock, objects, regions and paths."""
    layers = [*_maps(content), *_rock(content.report.surface), *_objects(content), *_regions(content)]
    return [each for each in (*layers, *_paths(content)) if len(each.points)]


def pack(layers: Sequence[Layer]) -> tuple[dict[str, Any], str]:
    """Return what a script needs to draw layers, and their points as Base64 of 16-bit numbers.

    Every coordinate is stored as a whole number of steps from the lowest corner of all layers; a step is 1 / 65,535 of
    the longest edge of their box: 2 mm at 100 m.

    Returns:
        `origin` (3,) and `step`, metres, and for each of `layers` its `group`, `kind`, `rgb` (0 to 1), `size`, `shown`,
        `name`, and `start` and `n` of its points; and the points, 3 numbers each, little-endian.
    """
    every = np.concatenate([np.zeros((0, 3)), *(layer.points for layer in layers)])
    low = every.min(axis=0, initial=np.inf) if len(every) else np.zeros(3)
    step = max(float(np.ptp(every, axis=0).max()) if len(every) else 0.0, 1.0) / _LARGEST
    starts = np.cumsum([0, *(len(layer.points) for layer in layers)]).tolist()
    entries = [
        {
            "group": layer.group, "kind": layer.kind, "rgb": [part / 255 for part in layer.rgb], "size": layer.size_m,
            "shown": layer.is_shown, "name": layer.name or layer.group, "start": start, "n": len(layer.points),
        }
        for layer, start in zip(layers, starts, strict=False)
    ]  # fmt: skip
    numbers = np.round((every - low) / step).astype("<u2")
    head = {"origin": low.tolist(), "step": step, "layers": entries}
    return head, base64.b64encode(numbers.tobytes()).decode("ascii")


def spread(n: int, most: int) -> Int64Array:
    """Return at most `most` of the places 0 to n - 1, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def _maps(content: AnswerContent) -> Iterator[Layer]:
    of_each = content.maps, content.cells_m, content.paths, (BEFORE_RGB, AFTER_RGB)
    for name, points, cell_m, path, rgb in zip(("before", "after"), *of_each, strict=True):
        is_roof = roof_mask(points, path)
        yield Layer(f"map {name}", "points", points[~is_roof], rgb, _FILLED * cell_m)
        yield Layer(f"roof {name}", "points", points[is_roof], rgb, _FILLED * cell_m, is_shown=False)


def _rock(surface: SurfaceField | None) -> Iterator[Layer]:
    """Yield the places of regions that moved, and all others that were measured, by class of displacement."""
    if surface is None:
        return
    number = displacement_class(np.nan_to_num(surface.displacement_m))
    is_moved, is_known = surface.region >= 0, np.isfinite(surface.displacement_m)
    cell_m = _ROCK_CELL_M
    while len(thin(surface.points_map[is_known], cell_m)) > _MAX_ROCK:
        cell_m *= _LARGER
    for group, chosen in ((MOVED_ROCK, is_moved & is_known), (ELSEWHERE, ~is_moved & is_known)):
        for each in np.unique(number[chosen]).tolist():
            points = thin(surface.points_map[chosen & (number == each)], cell_m)
            size_m, is_shown, name = max(cell_m, _ROCK_POINT_M), group == MOVED_ROCK, class_name(each)
            yield Layer(group, "points", points, ROCK_RGB[each], size_m, is_shown, f"rock {name}")


def _objects(content: AnswerContent) -> Iterator[Layer]:
    for kind, rgb in CHANGE_RGB.items():
        own = [item.points_map for item in content.report.objects if item.kind == kind and len(item.points_map)]
        if own:
            yield Layer(kind, "points", thin(np.concatenate(own), _OBJECT_CELL_M), rgb, OBJECT_POINT_M)


def _regions(content: AnswerContent) -> Iterator[Layer]:
    regions = content.report.regions
    for index in np.flatnonzero(regions.is_reported).tolist():
        circles = sphere_path(regions.centres_map[index], regions.radii_m[index])
        yield Layer("regions", "line", circles, REGION_RGB, name=f"region {index}")


def _paths(content: AnswerContent) -> Iterator[Layer]:
    """Yield both paths, the before one apart where it was not compared."""
    coverage = content.report.coverage
    assert coverage is not None
    few, few_after = (spread(len(path), _MAX_PATH) for path in content.paths)
    before, after = content.paths[0][few], content.paths[1][few_after]
    is_near = np.logical_and.reduceat(coverage.is_near, few)  # what was not seen stays red
    for wanted, name, rgb in ((True, "path before", BEFORE_RGB), (False, "path before, not seen", WRONG_RGB)):
        for stretch in near_stretches(is_near, wanted=wanted):
            yield Layer(name, "line", before[stretch], rgb)
    yield Layer("path after", "line", after, AFTER_RGB)
