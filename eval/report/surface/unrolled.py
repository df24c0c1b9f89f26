"""Unrolled maps of one pair: the displacement of the rock over chainage and angle, the truth above each answer."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, travelled_m
from cdpipe.io.answer import read_answer
from eval.core.figures import blank_figure, data_address, plain_text
from eval.report.tables import Picture
from eval.running.run_data import Row, RunData, named_variants, number
from eval.scoring.merge_metrics import find_travel_directions
from eval.scoring.surface_places import SurfacePlaces, carry_surface, find_surface_places
from eval.truth.ground_truth import load_ground_truth

MAX_METHODS = 6
_BIN_M = 1.0
_LEAST_MM = 10.0
_UP = np.array([0.0, 0.0, 1.0])


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
    chainage_m, angle_deg = unroll(places.points_map, truth.before.odom_T_sensor)
    return [_picture(chosen, places, panels, chainage_m, angle_deg)], missing


def unroll(points_map: Float64Array, odom_T_sensor: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return chainage and angle about the drift's axis of places on the rock.

    Args:
        points_map: (P, 3) places, the before session's odom frame, metres.
        odom_T_sensor: (S, 4, 4) poses of the before session.

    Returns:
        (P,) metres along the path of the before session, and (P,) degrees: 0 the crown of the roof, 90 the left wall
        looking along the path, -90 the right wall, 180 and -180 the floor. The axis lies in each metre of path midway
        between the walls, and between roof and floor.
    """
    along_m = travelled_m(odom_T_sensor)
    directions = find_travel_directions(odom_T_sensor)
    is_known = np.isfinite(directions).all(axis=1)
    if len(points_map) == 0 or not is_known.any():
        return np.full(len(points_map), np.nan), np.full(len(points_map), np.nan)
    positions, directions, along_m = odom_T_sensor[is_known, :3, 3], directions[is_known], along_m[is_known]
    _, nearest = cKDTree(positions).query(points_map)
    ahead = directions[nearest]
    left = np.cross(_UP, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(ahead, left)
    offset = points_map - positions[nearest]
    chainage_m = along_m[nearest] + np.einsum("pi,pi->p", offset, ahead)
    aside_m, above_m = (np.einsum("pi,pi->p", offset, axis) for axis in (left, up))
    metre = np.floor(chainage_m / _BIN_M).astype(np.int64)
    for values in (aside_m, above_m):
        for each in np.unique(metre):
            inside = metre == each
            values[inside] -= values[inside].min() / 2 + values[inside].max() / 2
    return chainage_m, np.rad2deg(np.arctan2(aside_m, above_m))


def _picture(
    row: Row,
    places: SurfacePlaces,
    panels: list[tuple[str, Float64Array]],
    chainage_m: Float64Array,
    angle_deg: Float64Array,
) -> Picture:
    judged = places.is_judged
    moved_mm = 1000.0 * np.abs(places.true_m[judged & places.is_changed])
    bound_mm = max(_LEAST_MM, float(np.percentile(moved_mm, 95)) if len(moved_mm) else 0.0)
    figure = blank_figure(9.0, 0.6 + 1.15 * len(panels))
    axes_of_panels = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, values_m) in zip(axes_of_panels, panels, strict=True):
        axes.set_facecolor("#d9d9d9")
        dots = axes.scatter(
            chainage_m[judged], angle_deg[judged], c=1000.0 * values_m[judged], s=1.2, linewidths=0, cmap="RdBu_r",
            vmin=-bound_mm, vmax=bound_mm, plotnonfinite=False,
        )  # fmt: skip
        axes.set_ylim(-180, 180)
        axes.set_yticks([-180, -90, 0, 90, 180], ["floor", "right", "crown", "left", "floor"])
        axes.tick_params(labelsize=7)
        axes.set_title(plain_text(name), fontsize=8, loc="left", pad=2)
    axes_of_panels[-1].set_xlabel("chainage [m]", fontsize=8)
    figure.colorbar(dots, ax=list(axes_of_panels), label="displacement into the void [mm]", shrink=0.7)
    caption = (
        "Displacement at the judged places, over the path of the before session and the angle about the drift's axis. "
        f"Grey: not measured. Colours end at {bound_mm:.0f} mm."
    )
    return Picture(f"{row['scenario']}, seed {int(row['seed'])}: the unrolled surface", data_address(figure), caption)
