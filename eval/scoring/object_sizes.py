"""Errors of the answered displacements and volumes of objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float64Array
from cdpipe.model.report import ChangedObject
from eval.core.statistics import median
from eval.scoring.object_metrics import ObjectMatches
from eval.scoring.region_metrics import transform_to_map
from eval.scoring.twins import Label, label_changes, list_drawn_labels
from eval.truth.ground_truth import GroundTruth
from sim.session.truth import Change

PILE_KIND = "muck_pile"
# Within this angle an object of unknown height counts as upright alike: half a metre of it moves its middle by 2 cm.
_SAME_UP_DEG = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class SizeErrors:
    """Errors of the matched changes; NaN without a match, without an answered figure, or without a true one.

    Attributes:
        displacement_m: (C,) length of the difference of answered and true displacement, for both halves of a move.
        volume_share: (C,) (answered volume - true volume) / true volume.
    """

    displacement_m: Float64Array
    volume_share: Float64Array


def compute_size_errors(objects: Sequence[ChangedObject], matches: ObjectMatches, truth: GroundTruth) -> SizeErrors:
    """Compare the displacement and the volume of each matched object with its change's.

    Args:
        objects: The answer's objects.
        matches: Matching of objects and changes.
        truth: The pair's truth.
    """
    changes = truth.pair.changes
    errors = SizeErrors(*(np.full(len(changes), np.nan) for _ in range(2)))
    moves = find_true_displacements_map(truth, label_changes(objects, matches.matched_object, truth))
    for index in np.flatnonzero(matches.matched_object >= 0):
        item = objects[matches.matched_object[index]]
        if item.displacement_map is not None:
            errors.displacement_m[index] = np.linalg.norm(item.displacement_map - moves[index])
        volume_m3 = find_true_volume_m3(changes[index])
        if item.shape is not None and volume_m3 > 0:
            errors.volume_share[index] = (item.shape.volume_m3 - volume_m3) / volume_m3
    return errors


def find_true_displacements_map(truth: GroundTruth, labels: Sequence[Label] | None = None) -> Float64Array:
    """Return the (C, 3) displacement of each moved object, map frame, metres; NaN for objects that did not move.

    A displacement joins the centres of the object's bounding box before and after the move. Each centre is transformed
    into the map frame by the true pose of the judged before scan nearest to it in the world. The drift of the before
    odometry between both places belongs to the map frame and is no error of the answer. The truth knows no height of a
    prop from a mesh, so one that fell over or got up has none.

    Args:
        truth: The pair's truth, C changes.
        labels: (C,) what happened to each change; None: what the scenario says.
    """
    changes = truth.pair.changes
    if not changes:
        return np.zeros((0, 3))
    props = truth.pair.scenario.get("props", ())
    heights_m = {prop["name"]: float(prop["size_m"][2]) for prop in props if prop.get("size_m")}
    middles_world = np.array([_find_middle_world(change, heights_m.get(change.name, 0.0)) for change in changes])
    places = transform_to_map(middles_world, truth.before)
    moves = np.full((len(changes), 3), np.nan)
    for index, (change, label) in enumerate(zip(changes, labels or list_drawn_labels(truth), strict=True)):
        other = changes[label.other]
        if label.other >= 0 and (change.name in heights_m or _are_upright_alike(change, other)):
            ends = (label.other, index) if change.session == "after" else (index, label.other)
            moves[index] = places[ends[1]] - places[ends[0]]
    return moves


def find_true_volume_m3(change: Change) -> float:
    """Return the volume of a change: of its closed surface or, for props of several parts, of its convex hull.

    For a reshaped prop it is the removed volume. NaN for a short move, where only a part of the object is its truth.
    """
    if change.group == "partial" and change.kind == "moved":
        return float("nan")
    return change.hull_volume_m3 if change.mesh_volume_m3 is None else change.mesh_volume_m3


def summarise_size_errors(errors: SizeErrors, truth: GroundTruth) -> dict[str, float]:
    """Return the columns of results.csv: medians over the matched changes that have a number; NaN without one."""
    is_pile = np.array([change.prop_kind == PILE_KIND for change in truth.pair.changes], dtype=np.bool_)
    return {
        "displacement_error_m": median(errors.displacement_m),
        "pile_volume_error": median(np.abs(errors.volume_share[is_pile])),
    }


def _are_upright_alike(a: Change, b: Change) -> bool:
    """Tell whether two objects have the same direction upwards."""
    up_a, up_b = (np.asarray(each.world_T_object)[:3, 2] for each in (a, b))
    return bool(up_a @ up_b >= np.cos(np.deg2rad(_SAME_UP_DEG)))


def _find_middle_world(change: Change, height_m: float) -> Float64Array:
    """Return the (3,) centre of an object, whose own origin is on the floor, in any orientation."""
    pose = np.asarray(change.world_T_object)
    return np.asarray(pose[:3, :3] @ (0.0, 0.0, height_m / 2) + pose[:3, 3])
