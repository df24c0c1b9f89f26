"""The page of one answer: what changed in one sentence, the pair in 3-D, and its objects. One file, no network.

The page draws points itself with WebGL (`answer.js`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cdpipe.core.geometry import Float64Array
from eval.core.figures import blank_figure, data_address
from eval.report.answer.content import AnswerContent
from eval.report.answer.layers import Layer, list_layers, pack, spread
from eval.report.answer.tables import object_place, tabulate_objects, tabulate_regions, tabulate_rock
from eval.report.drawing.charts import script_json
from eval.report.maps import style_map_axes
from eval.report.render import render_page, write_file
from eval.report.tables import Cell, Table

if TYPE_CHECKING:
    import pandas as pd

# Places of the slider along the path, at most; and largest number of names in the picture.
_PLACES, _MAX_LABELS = 1000, 200
# Of the picture from above.
_DRAWN_POINTS, _AROUND_M, _WIDTH_IN = 60_000, 8.0, 9.0
_DIGITS = 8  # of a coordinate: a tenth of a millimetre a kilometre from the origin


def write_answer_page(content: AnswerContent, file: Path) -> None:
    """Write the page of an answer.

    Raises:
        InputError: The file cannot be written.
    """
    write_file(file, render_answer_page(content))


def render_answer_page(content: AnswerContent) -> str:
    """Return the page of an answer as HTML."""
    report, layers = content.report, list_layers(content)
    head, points = pack(layers)
    tables = [_as_table("Objects", tabulate_objects(report))]
    if report.surface is not None:
        tables.append(_as_table("Rock that moved (positive: into the void)", tabulate_rock(report.surface)))
    tables.append(_as_table("Regions", tabulate_regions(report)))
    shown = {
        "names": content.names, "method": content.method, "sentence": str(report), "tables": tables,
        "scene": script_json({**head, **_places(content), "names": _labels(content)}, _DIGITS), "points": points,
        "legend": _legend(layers),
        "from_above": data_address(draw_from_above(layers, content.paths)),
    }  # fmt: skip
    return render_page("answer.html", shown)


def draw_from_above(layers: Sequence[Layer], paths: Sequence[Float64Array]) -> Figure:
    """Return a figure of the layers that are visible at first, seen from above, around both (S, 3) paths."""
    plan = np.concatenate(paths)[:, :2]
    low, high = plan.min(axis=0) - _AROUND_M, plan.max(axis=0) + _AROUND_M
    width_m, height_m = (high - low).tolist()
    figure = blank_figure(_WIDTH_IN, float(np.clip(_WIDTH_IN * height_m / width_m, 2.0, _WIDTH_IN)) + 0.6)
    axes = figure.add_subplot()
    for layer in (each for each in layers if each.is_shown):
        colour = tuple(part / 255 for part in layer.rgb)
        if layer.kind == "line":
            axes.plot(*layer.points[:, :2].T, color=colour, linewidth=0.8)
        else:
            few = layer.points[:: max(1, len(layer.points) // _DRAWN_POINTS)]
            size = 0.5 if layer.group.startswith("map") else 3.0
            axes.scatter(few[:, 0], few[:, 1], s=size, color=[colour], linewidths=0.0)
    style_map_axes(axes)
    axes.set(xlabel="x [m]", ylabel="y [m]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure


def _legend(layers: Sequence[Layer]) -> dict[str, str]:
    """Return the colour of everything that is visible at first, by its name."""
    shown = (each for each in layers if each.is_shown)
    named = {each.group if each.group == "regions" else each.name or each.group: each.rgb for each in shown}
    return {name: "#" + bytes(rgb).hex() for name, rgb in named.items()}


def _places(content: AnswerContent) -> dict[str, Any]:
    """Return places along the before path, their chainage and whether they were compared, and where to look first."""
    path, coverage = content.paths[0], content.report.coverage
    assert coverage is not None
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    chosen = spread(len(path), _PLACES)
    start = int(np.argmin(np.linalg.norm(path[chosen] - _first_place(content), axis=1)))
    return {"path": path[chosen], "chainage": way_m[chosen], "near": coverage.is_near[chosen], "at": start}


def _first_place(content: AnswerContent) -> Float64Array:
    """Return the first object, region or place of rock, else the middle of the before path."""
    report = content.report
    places = [object_place(item) for item in report.objects if len(item.points_map)]
    places += list(report.regions.centres_map[report.regions.is_reported])
    places += [] if report.surface is None else [item.centre_map for item in report.surface.regions]
    return places[0] if places else content.paths[0][len(content.paths[0]) // 2]


def _labels(content: AnswerContent) -> list[dict[str, Any]]:
    """Return the name and the place of each object, and of each reported region without one."""
    report = content.report
    found = [
        {"text": f"{index} {item.kind}", "group": item.kind, "at": [*item.points_map.mean(axis=0)[:2], top_m]}
        for index, item in enumerate(report.objects)
        if len(item.points_map) and (top_m := float(item.points_map[:, 2].max()) + 0.2)
    ]
    held = {item.region for item in report.objects}
    found += [
        {"text": f"region {index}", "group": "regions", "at": report.regions.centres_map[index]}
        for index in np.flatnonzero(report.regions.is_reported).tolist()
        if index not in held
    ]
    return found[:_MAX_LABELS]


def _as_table(caption: str, frame: pd.DataFrame) -> Table:
    """Return a data frame as a table of the page, a dash for what is unknown."""
    rows = tuple(("", tuple(Cell(_text(value)) for value in row)) for row in frame.itertuples(index=False))
    return Table(tuple(frame.columns), rows, caption if rows else f"{caption}: none")


def _text(value: object) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
