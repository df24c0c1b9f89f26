"""Twins: which of several equal props went where is a label of the scenario and not in the scans.

Where twins stood before and where they stand after is the truth. Every labelling of these places with at least as many
moves as the scenario's explains the scans as well, so an answer is judged by the labelling that suits it best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cdpipe.core.geometry import BoolArray, Int64Array
from cdpipe.model.report import ChangedObject
from eval.truth.ground_truth import SESSIONS, GroundTruth
from sim.session.truth import Change, Kind, SessionName

# Largest difference of each edge of twins: half a scoring cell, so that both fill about the same cells.
TWIN_M = 0.05
# Kinds of which every prop has a shape of its own, drawn by its name.
_DRAWN_KINDS = ("muck_pile", "rock")
# Mesh, as the scenario names it, and edges.
Shape = tuple[Any, tuple[float, ...]]
_ALONE: dict[SessionName, Kind] = {"before": "removed", "after": "added"}
_IMPOSSIBLE = -1e6
# What the scenario's own label of one change is worth: it decides between labellings that suit an answer equally well.
_AS_DRAWN = 1e-4


@dataclass(frozen=True, slots=True)
class Label:
    """What happened to a change: its kind, and the index of the other half of a move, -1 without one."""

    kind: Kind
    other: int


def list_drawn_labels(truth: GroundTruth) -> tuple[Label, ...]:
    """Return the label of each of C changes as the scenario has it."""
    at = {change.id: index for index, change in enumerate(truth.pair.changes)}
    return tuple(
        Label(change.kind, at.get(change.partner, -1) if change.kind == "moved" and change.partner is not None else -1)
        for change in truth.pair.changes
    )


def list_twins(truth: GroundTruth) -> list[list[int]]:
    """Return for each of C changes the ids of those among which labels are exchanged; none where its label is fixed."""
    changes, drawn = truth.pair.changes, list_drawn_labels(truth)
    found: list[list[int]] = [[] for _ in changes]
    for before, after, _ in _find_groups(truth, drawn):
        members = sorted((*before, *after))
        if len(members) == 2 and drawn[before[0]].other == after[0]:
            continue  # both halves of one move
        for index in members:
            found[index] = [changes[other].id for other in members if other != index]
    return found


def label_changes(
    objects: Sequence[ChangedObject], matched_object: Int64Array, truth: GroundTruth
) -> tuple[Label, ...]:
    """Return the label of each of C changes: the scenario's, and among twins the labels that suit an answer best.

    Args:
        objects: The answer's objects.
        matched_object: (C,) object of each change, -1 for none.
        truth: The pair's truth.
    """
    changes, drawn = truth.pair.changes, list_drawn_labels(truth)
    labels = list(drawn)

    def worth(index: int, label: Label) -> float:
        is_right = matched_object[index] >= 0 and is_kind_right(objects, matched_object, truth, index, label)
        return float(is_right) + _AS_DRAWN * (label == drawn[index])

    for before, after, are_twins in _find_groups(truth, drawn):
        n_moves = sum(drawn[index].kind == "moved" for index in before)
        for index in (*before, *after):
            labels[index] = Label(_ALONE[changes[index].session], -1)
        for r, a in _find_best_links(before, after, are_twins, n_moves, worth):
            labels[r], labels[a] = Label("moved", a), Label("moved", r)
    return tuple(labels)


def is_kind_right(
    objects: Sequence[ChangedObject], matched_object: Int64Array, truth: GroundTruth, index: int, label: Label
) -> bool:
    """Return whether the object matched to a change has the kind of a label.

    A moved object must be linked with the object matched to the other half. If that half is not observable, the kind
    that one session alone shows is right as well: added in the after session, removed in the before session.
    """
    item = objects[matched_object[index]]
    is_right = bool(item.kind == label.kind)
    if label.other < 0:
        return is_right
    if truth.is_observable[label.other]:
        return is_right and item.partner >= 0 and item.partner == int(matched_object[label.other])
    return is_right or item.kind == _ALONE[truth.pair.changes[index].session]


def _find_groups(truth: GroundTruth, drawn: Sequence[Label]) -> Iterator[tuple[list[int], list[int], BoolArray]]:
    """Yield the groups of changes that twins connect: those of before, those of after, and which pairs are of twins.

    Only whole objects that came, went or moved from one place to another belong to a group.
    """
    changes = truth.pair.changes
    is_whole = [change.group == "full" for change in changes]
    free = [
        index
        for index, label in enumerate(drawn)
        if is_whole[index] and (label.kind in ("added", "removed") or (label.other >= 0 and is_whole[label.other]))
    ]
    before, after = ([index for index in free if changes[index].session == session] for session in SESSIONS)
    shapes = _read_shapes(truth)
    are_twins = np.zeros((len(before), len(after)), np.bool_)
    for row, r in enumerate(before):
        for column, a in enumerate(after):
            are_twins[row, column] = drawn[r].other == a or _are_twins(changes[r], changes[a], shapes)
    rows, columns = np.nonzero(are_twins)
    edges = coo_matrix((np.ones(len(rows)), (rows, len(before) + columns)), (len(free), len(free)))
    n_groups, group = connected_components(edges, directed=False)
    for number in range(n_groups):
        rows, columns = (np.flatnonzero(each == number) for each in (group[: len(before)], group[len(before) :]))
        if len(rows) and len(columns):
            yield [before[k] for k in rows], [after[k] for k in columns], are_twins[np.ix_(rows, columns)]


def _read_shapes(truth: GroundTruth) -> dict[str, Shape]:
    """Return the mesh, None for a built prop, and the edges of each prop by name, metres."""
    return {
        prop["name"]: (prop.get("mesh"), tuple(prop.get("size_m") or ()))
        for prop in truth.pair.scenario.get("props", ())
        if prop.get("mesh") or prop.get("size_m")
    }


def _are_twins(one: Change, other: Change, shapes: Mapping[str, Shape]) -> bool:
    """Return whether nothing tells two props apart: one kind, one shape, and edges that differ by 5 cm at most."""
    if one.prop_kind != other.prop_kind or one.prop_kind in _DRAWN_KINDS or not {one.name, other.name} <= set(shapes):
        return False
    (mesh, size_m), (other_mesh, other_size_m) = shapes[one.name], shapes[other.name]
    return bool(mesh == other_mesh and np.allclose(size_m, other_size_m, rtol=0.0, atol=TWIN_M))


def _find_best_links(
    before: Sequence[int],
    after: Sequence[int],
    are_twins: BoolArray,
    n_moves: int,
    worth: Callable[[int, Label], float],
) -> list[tuple[int, int]]:
    """Return the pairs (before, after) of the most worthy labelling of a group with at least `n_moves` moves.

    The assignment has an extra column for each change of before that may be left alone, and an extra row for each of
    after.
    """
    n_rows, n_columns = len(before), len(after)
    worths = np.zeros((n_rows + n_columns - n_moves,) * 2)
    for row, r in enumerate(before):
        worths[row, n_columns:] = worth(r, Label("removed", -1))
        for column, a in enumerate(after):
            is_possible = are_twins[row, column]
            worths[row, column] = (
                worth(r, Label("moved", a)) + worth(a, Label("moved", r)) if is_possible else _IMPOSSIBLE
            )
    for column, a in enumerate(after):
        worths[n_rows:, column] = worth(a, Label("added", -1))
    pairs = zip(*(each.tolist() for each in linear_sum_assignment(worths, maximize=True)), strict=True)
    return [(before[row], after[column]) for row, column in pairs if row < n_rows and column < n_columns]
