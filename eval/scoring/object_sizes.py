"""How far a moved object went and how much a thing takes up, as answered, against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.model.report import ChangedObject
from eval.scoring.object_metrics import ObjectMatches
from eval.scoring.region_metrics import places_in_map
from eval.truth.ground_truth import GroundTruth
from sim.session.truth import Change

PILE_KIND = "muck_pile"


@dataclass(frozen=True, slots=True, eq=False)
class SizeErrors:
    """Errors of the matched changes; NaN where nothing is matched, nothing was answered, or nothing is known.

    Attributes:
        displacement_m: (C,) length of the answered displacement minus the true one, both halves of a move.
        volume_share: (C,) (answered volume - true volume) / true volume.
    """

    displacement_m: Float64Array
    volume_share: Float64Array


def size_errors(
    objects: Sequence[ChangedObject], matches: ObjectMatches, truth: GroundTruth, keyframe_scans: Int64Array
) -> SizeErrors:
    """Compare the displacement and the volume of each matched object with its change's.

    Args:
        objects: The answer's objects.
        matches: Which of them stands for which change.
        truth: The pair's truth.
        keyframe_scans: Scans of the before keyframes, through which places are carried into the map frame.
    """
    changes = truth.pair.changes
    errors = SizeErrors(*(np.full(len(changes), np.nan) for _ in range(2)))
    moves = true_displacements_map(truth, keyframe_scans)
    for index in np.flatnonzero(matches.matched_object >= 0):
        item = objects[matches.matched_object[index]]
        if item.displacement_map is not None:
            errors.displacement_m[index] = np.linalg.norm(item.displacement_map - moves[index])
        volume_m3 = true_volume_m3(changes[index])
        if item.shape is not None and volume_m3 > 0:
            errors.volume_share[index] = (item.shape.volume_m3 - volume_m3) / volume_m3
    return errors


def true_displacements_map(truth: GroundTruth, keyframe_scans: Int64Array) -> Float64Array:
    """Return (C, 3) from where each moved object stood to where it stands, map frame, metres; NaN for what never moved.

    The middle of the object's bounding box goes from one place to the other. Each of the two places is carried into
    the map frame through the true pose of the before keyframe that is truly nearest to it: how far the before odometry
    drifts between them belongs to the map frame and is no error of the answer.
    """
    changes = truth.pair.changes
    if not changes:
        return np.zeros((0, 3))
    heights_m = _heights_m(truth.pair.scenario)
    middles_world = np.array([_middle_world(change, heights_m.get(change.name, 0.0)) for change in changes])
    places = places_in_map(middles_world, truth.before, keyframe_scans)
    at = {change.id: index for index, change in enumerate(changes)}
    moves = np.full((len(changes), 3), np.nan)
    for index, change in enumerate(changes):
        if change.kind == "moved" and change.partner in at:
            ends = (at[change.partner], index) if change.session == "after" else (index, at[change.partner])
            moves[index] = places[ends[1]] - places[ends[0]]
    return moves


def true_volume_m3(change: Change) -> float:
    """Return the volume of a change: of its closed surface or, for props of several parts, of its convex hull.

    Of a reshaped prop it is that of what is gone. NaN for a short move: only a part of the object is its truth.
    """
    if change.group == "partial" and change.kind == "moved":
        return float("nan")
    return change.hull_volume_m3 if change.mesh_volume_m3 is None else change.mesh_volume_m3


def size_columns(errors: SizeErrors, truth: GroundTruth) -> dict[str, float]:
    """Return the columns of results.csv: medians over the matched changes that have a number; NaN without one."""
    is_pile = np.array([change.prop_kind == PILE_KIND for change in truth.pair.changes], dtype=np.bool_)
    return {
        "displacement_error_m": _median(errors.displacement_m),
        "pile_volume_error": _median(np.abs(errors.volume_share[is_pile])),
    }


def _heights_m(scenario: Mapping[str, Any]) -> dict[str, float]:
    """Return the height of every prop that says its own."""
    return {prop["name"]: float(prop["size_m"][2]) for prop in scenario.get("props", ()) if prop.get("size_m")}


def _middle_world(change: Change, height_m: float) -> Float64Array:
    """Return (3,) the middle of an object, whose own origin is on the floor; it may stand, lean or lie."""
    pose = np.asarray(change.world_T_object, dtype=np.float64)
    return np.asarray(pose[:3, :3] @ (0.0, 0.0, height_m / 2) + pose[:3, 3])


def _median(values: Float64Array) -> float:
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else float("nan")
