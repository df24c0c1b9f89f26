"""Unrolled maps of one pair: the displacement of the rock over chainage and angle, the truth above each answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.answer import read_answer
from cdpipe.surface import unroll
from eval.core.figures import blank_figure, data_address, plain_text
from eval.report.tables import Picture
from eval.running.results.cases import named_variants
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, number
from eval.scoring.surface.places import SurfacePlaces, carry_surface, find_surface_places
from eval.truth.ground_truth import load_ground_truth

MAX_METHODS = 6
_LEAST_MM = 10.0


def draw_unrolled(data: RunData) -> tuple[list[Picture], list[str]]:
    """Return the unrolled map of one pair, and what could not be drawn.

    The pair is the one with most observable surface changes, of equal ones the first of results.csv.
    """
    rows = [row for row in data.results if number(row, "n_surface_changes") > 0]
    if not rows:
        return [], []
    chosen = max(rows, key=lambda row: number(row, "n_surface_changes"))
    scenario, seed = str(chosen["scenario"]), int(chosen["seed"])
    try:
        truth = load_ground_truth(data.folder.pair(scenario, seed))
    except InputError:
        return [], [f"The simulated pair {scenario}, seed {seed}, is not in the run folder: its map is not drawn."]
    places = find_surface_places(truth)
    panels, missing = [("truth", places.true_m)], []
    for name in named_variants(data, scenario)[:MAX_METHODS]:
        try:
            report = read_answer(data.folder.answer(scenario, seed, name)).report
        except InputError:
            missing.append(f"The answer of {name} to {scenario}, seed {seed}, is not in the run folder.")
            continue
        said = carry_surface(None if report is None else report.surface, places)
        panels.append((name, np.where(said.is_covered, said.answered_m, np.nan)))
    chainage_m, angle_deg, _ = unroll(places.points_map, truth.before.odom_T_sensor)
    return [_picture(chosen, places, panels, chainage_m, angle_deg)], missing


def _picture(
    row: Row,
    places: SurfacePlaces,
    panels: list[tuple[str, Float64Array]],
    chainage_m: Float64Array,
    angle_deg: Float64Array,
) -> Picture:
    judged = places.is_judged
    moved_m = np.abs(places.true_m[judged & places.is_changed])
    shown = [(name, values_m[judged]) for name, values_m in panels]
    figure, bound_mm = draw_panels(shown, chainage_m[judged], angle_deg[judged], moved_m)
    caption = (
        "Displacement at the judged places, over the path of the before session and the angle about the drift's axis. "
        f"Grey: not measured. Colours end at {bound_mm:.0f} mm."
    )
    return Picture(f"{row['scenario']}, seed {int(row['seed'])}: the unrolled surface", data_address(figure), caption)


def draw_panels(
    panels: Sequence[tuple[str, Float64Array]], chainage_m: Float64Array, angle_deg: Float64Array, moved_m: Float64Array
) -> tuple[Figure, float]:
    """Return unrolled maps one above the other, and the displacement at which their colours end, millimetres.

    Args:
        panels: The title of each map and the (P,) displacements that it shows, metres; NaN is grey.
        chainage_m: (P,) of the places.
        angle_deg: (P,) of the places: 0 the crown of the roof, 90 the left wall.
        moved_m: (M,) magnitudes of what moved: colours end at their 95th percentile.
    """
    bound_mm = max(_LEAST_MM, 1000.0 * float(np.percentile(moved_m, 95)) if len(moved_m) else 0.0)
    figure = blank_figure(9.0, 0.6 + max(1.15 * len(panels), 1.8))
    axes_of_panels = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, values_m) in zip(axes_of_panels, panels, strict=True):
        axes.set_facecolor("#d9d9d9")
        dots = axes.scatter(
            chainage_m, angle_deg, c=1000.0 * values_m, s=1.2, linewidths=0, cmap="RdBu_r",
            vmin=-bound_mm, vmax=bound_mm, plotnonfinite=False,
        )  # fmt: skip
        axes.set_ylim(-180, 180)
        axes.set_yticks([-180, -90, 0, 90, 180], ["floor", "right", "crown", "left", "floor"])
        axes.tick_params(labelsize=7)
        axes.set_title(plain_text(name), fontsize=8, loc="left", pad=2)
    axes_of_panels[-1].set_xlabel("chainage [m]", fontsize=8)
    bar = figure.colorbar(dots, ax=list(axes_of_panels), shrink=0.9)
    bar.set_label("displacement [mm]", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure, bound_mm
