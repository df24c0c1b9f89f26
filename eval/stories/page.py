"""One offline page about a story, with its tables as CSV files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array
from cdpipe.model.report import SurfaceField
from eval.core.charts import BLUE, CONTEXT, ORANGE, Axis, Drawing, Look, Panel, Series
from eval.core.figures import data_address
from eval.core.tablefile import csv_text
from eval.report.drawing.charts import Chart
from eval.report.render import render_page, write_file
from eval.report.surface.unrolled import draw_panels
from eval.report.tables import Cell, Picture, Table
from eval.stories.comparisons import Comparison, Method, refused_sessions
from eval.stories.places import RADIUS_M, ChosenPlace, choose_places, follow_places, is_measured
from eval.stories.props import HIDDEN, MISSED, NO_ANSWER, OTHER_KIND, RIGHT, count_objects, follow_props
from eval.tables.columns import UNDEFINED
from sim.story import Story, is_story, read_story

_IN_ROW, _ROW_PX = 2, 230
_COLOURS = {RIGHT: "#d3e7f5", OTHER_KIND: "#fbeecb", MISSED: "#fbdcc8", HIDDEN: "#eeeeee", NO_ANSWER: "#eeeeee"}


def write_story_page(
    story: Path, out: Path, method: Method, comparisons: Sequence[Comparison], given: Sequence[Float64Array] = ()
) -> pd.DataFrame:
    """Write index.html, displacement.csv and props.csv.

    Args:
        story: Folder of the story.
        out: Folder of the report.
        method: What answered.
        comparisons: Session 1 against each later session.
        given: Places (3,) in the odom frame of session 1 that the user names, metres.

    Returns:
        A row for each place: what was measured at every later session, as text in millimetres.

    Raises:
        InputError: A place is nowhere near rock, or nothing can be written.
    """
    places = choose_places(comparisons, given)
    moved, props = follow_places(comparisons, places), follow_props(comparisons)
    content = _content(story, method, comparisons, (places, moved, props))
    write_file(out / "displacement.csv", csv_text(moved))
    write_file(out / "props.csv", csv_text(props))
    write_file(out / "index.html", render_page("story.html", content))
    table = displacement_table(moved, has_truth=False)
    return pd.DataFrame([[cell.text for cell in cells] for _, cells in table.rows], columns=list(table.headings))


def _content(
    story: Path,
    method: Method,
    comparisons: Sequence[Comparison],
    found: tuple[Sequence[ChosenPlace], pd.DataFrame, pd.DataFrame],
) -> dict[str, Any]:
    places, moved, props = found
    told = read_story(story) if is_story(story) else None
    has_truth = any(each.truth is not None for each in comparisons)
    charts = [draw_places(moved, places)] if places else []
    return {
        "is_slim": False,
        "title": f"{len(comparisons) + 1} sessions" if told is None else f"{told.scenario.family}, seed {told.seed}",
        "n_sessions": len(comparisons) + 1,
        "preset": method.preset,
        "settings": ", ".join(method.settings),
        "has_truth": has_truth,
        "refused": refused_sessions(comparisons),
        "is_measured": is_measured(comparisons),
        "charts": charts,
        "radius_m": RADIUS_M,
        "displacements": displacement_table(moved, has_truth=has_truth),
        "unrolled": draw_unrolled_story(comparisons),
        "props": props_table(props),
        "objects": objects_table(comparisons),
        "states": None if told is None or not has_truth else states_table(told),
    }


def draw_places(moved: pd.DataFrame, places: Sequence[ChosenPlace]) -> Chart:
    """Return a panel for each place: displacement over session, with its level, and the true displacement."""
    panels = [_panel(moved[moved["place"] == place.name], place) for place in places]
    rows = [panels[start : start + _IN_ROW] for start in range(0, len(panels), _IN_ROW)]
    caption = (
        "Displacement since session 1, positive into the void. Bars: 95 % level of detection. Where a bar reaches 0, "
        "the method cannot tell that the rock moved."
    )
    return Chart("places", "Displacement of single places", Drawing(rows, _ROW_PX), caption)


def _panel(own: pd.DataFrame, place: ChosenPlace) -> Panel:
    session, moved_mm = own["session"].to_numpy(), 1000.0 * own["displacement_m"].to_numpy()
    level_mm, true_mm = 1000.0 * own["level_m"].to_numpy(), 1000.0 * own["true_m"].to_numpy()
    series = [Series([1, *session], np.zeros(len(session) + 1), Look(CONTEXT, 1.0))]
    if np.isfinite(true_mm).any():
        look = Look(ORANGE, 1.6, marker="square", size=4.0)
        series.append(Series([1, *session], [0.0, *true_mm], look, "true", hover="session {x:.0f}: {y:.1f} mm"))
    look = Look(BLUE, 1.2, "dot", "circle", 5.0)
    ends = moved_mm - level_mm, moved_mm + level_mm
    name = "measured \u00b1 95 % level"
    series.append(Series(session, moved_mm, look, name, "line", *ends, hover="session {x:.0f}: {y:.1f} mm"))
    chainage_m, angle_deg = (float(own[name].median()) for name in ("chainage_m", "angle_deg"))
    where = "" if np.isnan(chainage_m) else f": {chainage_m:.1f} m along, {angle_deg:.0f}\u00b0"
    how = "" if place.chosen_by == "region" else " (given)"
    last = int(session.max(initial=2))
    ticks = {float(number): str(number) for number in range(1, last + 1)}
    x = Axis("session", (0.7, last + 0.3), ticks=ticks)
    return Panel(x, Axis("displacement [mm]"), series, f"{place.name}{how}{where}")


def displacement_table(moved: pd.DataFrame, *, has_truth: bool) -> Table:
    """Return a row for each place: its displacement at every later session, in millimetres."""
    sessions = sorted(moved["session"].unique())
    rows = []
    for name in dict.fromkeys(moved["place"]):
        by_session = moved[moved["place"] == name].set_index("session")
        position = ", ".join(f"{by_session[axis].iloc[0]:.2f}" for axis in ("x_m", "y_m", "z_m"))
        cells = [_displacement_cell(by_session.loc[number], has_truth=has_truth) for number in sessions]
        rows.append(("", (Cell(name), Cell(position), *cells)))
    headings = ("place", "x, y, z [m]", *(f"session {number}" for number in sessions))
    return Table(headings, tuple(rows), "Displacement since session 1 [mm], \u00b1 95 % level of detection")


def _displacement_cell(row: pd.Series, *, has_truth: bool) -> Cell:
    true = f"true {_mm(row['true_m'])}" if has_truth else ""
    if not np.isfinite(row["displacement_m"]):
        return Cell(UNDEFINED, interval=true)
    level = f"{1000 * row['level_m']:.1f}" if np.isfinite(row["level_m"]) else UNDEFINED
    is_beyond = row["is_beyond_level"]
    return Cell(f"{_mm(row['displacement_m'])} \u00b1 {level}", pd.notna(is_beyond) and bool(is_beyond), true)


def _mm(value_m: float) -> str:
    return f"{1000 * value_m:+.1f}" if np.isfinite(value_m) else UNDEFINED


def props_table(props: pd.DataFrame) -> Table:
    """Return a row for each prop that changes: what happened since session 1, and what was answered."""
    sessions = sorted(props["session"].unique())
    rows = []
    for name, kind in dict.fromkeys(zip(props["prop"], props["prop_kind"], strict=True)):
        by_session = props[props["prop"] == name].set_index("session")
        cells = [_prop_cell(by_session.loc[number]) for number in sessions]
        rows.append(("", (Cell(f"{name} ({kind})"), *cells)))
    headings = ("prop", *(f"session {number}" for number in sessions))
    return Table(headings, tuple(rows), "Props since session 1: the truth, and below it the answer")


def _prop_cell(row: pd.Series) -> Cell:
    verdict = str(row["verdict"])
    if not verdict:
        return Cell(str(row["true_kind"]))
    answer = verdict
    if verdict in (RIGHT, OTHER_KIND):
        answer = f"{row['answered_kind']}, IoU {row['iou_point']:.2f}"
    return Cell(str(row["true_kind"]), verdict == RIGHT, answer, _COLOURS[verdict])


def objects_table(comparisons: Sequence[Comparison]) -> Table:
    """Return a row for each later session: how many objects were answered."""
    counts = count_objects(comparisons)
    has_truth = bool(counts["false"].notna().any())
    names = ["added", "removed", "moved", "reshaped", *(["false"] if has_truth else [])]
    rows = []
    for row in counts.to_dict("records"):
        cells = [Cell(UNDEFINED if pd.isna(row[name]) else str(int(row[name]))) for name in names]
        rows.append(("", (Cell(f"session {row['session']}"), *cells)))
    return Table(("against session 1", *names), tuple(rows), "Objects that were answered")


def states_table(story: Story) -> Table:
    """Return a row for each prop and rock that changes: its true state in every session."""
    scenario, sessions = story.scenario, story.sessions
    words = {"absent": "\u2013", "before": "stands", "after": "stands"}
    rows = []
    for prop in scenario.props:
        if prop.name not in sessions[0].places:
            continue
        is_twice = prop.change in ("moved", "reshaped") or prop.aged is not None
        own = words | ({"after": {"moved": "elsewhere", "reshaped": "loaded away"}.get(prop.change, "aged")}
                       if is_twice else {})  # fmt: skip
        cells = [Cell(own[state.places[prop.name]]) for state in sessions]
        rows.append(("props", (Cell(f"{prop.name} ({prop.kind})"), *cells)))
    for change in scenario.surface:
        shares = [state.shares[change.name] for state in sessions]
        cells = [Cell(f"{100 * share:.0f} %") for share in shares]
        rows.append(("rock, share of the change that has happened", (Cell(f"{change.name} ({change.kind})"), *cells)))
    headings = ("", *(str(number) for number in range(1, len(sessions) + 1)))
    return Table(headings, tuple(rows), "What is true in each session")


def draw_unrolled_story(comparisons: Sequence[Comparison]) -> Picture | None:
    """Return the unrolled displacement of every later session, at the places of the last answer that has any."""
    fields = [(each.number, each.answer.report.surface) for each in comparisons if each.answer.report is not None]
    known = [(number, field) for number, field in fields if field is not None and field.chainage_m is not None]
    if not known:
        return None
    last = known[-1][1]
    assert last is not None and last.chainage_m is not None and last.angle_deg is not None
    panels = [(f"session {number}", _displacement_at(last.points_map, field)) for number, field in known]
    moved_m = np.abs(last.displacement_m[last.region >= 0])
    figure, bound_mm = draw_panels(panels, last.chainage_m, last.angle_deg, moved_m[np.isfinite(moved_m)])
    caption = f"Along the drift and about its axis. Grey: not measured. Colours end at {bound_mm:.0f} mm."
    return Picture("Displacement since session 1, unrolled", data_address(figure), caption)


def _displacement_at(points: Float64Array, field: SurfaceField) -> Float64Array:
    """Return the displacement (P,) of the place nearest to each of (P, 3) points, within 0.3 m; NaN where none is."""
    if not len(field.points_map):
        return np.full(len(points), np.nan)
    apart_m, nearest = cKDTree(field.points_map).query(points)
    return np.where(np.asarray(apart_m) <= RADIUS_M, field.displacement_m[np.asarray(nearest)], np.nan)
