"""What became of each prop over the sessions of a story: the truth, and what was answered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from eval.stories.comparisons import Comparison

COLUMNS = ("prop", "prop_kind", "session", "true_kind", "is_observable", "answered_kind", "iou_point", "verdict")
UNCHANGED = "unchanged"
RIGHT, OTHER_KIND, MISSED, HIDDEN, NO_ANSWER = "right", "other kind", "missed", "not observable", "no answer"


def follow_props(comparisons: Sequence[Comparison]) -> pd.DataFrame:
    """Return a row for each prop that changes in any comparison and each later session, against session 1.

    A moved prop is two changes, one in either session; it is right where both are, and its IoU is the smaller one.
    """
    changes = {each.number: _changes_by_prop(each) for each in comparisons if each.score is not None}
    kinds = {row["name"]: row["prop_kind"] for found in changes.values() for rows in found.values() for row in rows}
    rows = []
    for name, kind in kinds.items():
        for each in comparisons:
            if each.number in changes:
                own = changes[each.number].get(name, [])
                rows.append({"prop": name, "prop_kind": kind, "session": each.number, **_judge(own, each)})
    return pd.DataFrame(rows, columns=list(COLUMNS))


def count_objects(comparisons: Sequence[Comparison]) -> pd.DataFrame:
    """Return a row for each later session: how many objects were answered, by kind, and how many are no change."""
    rows = []
    for each in comparisons:
        report = each.answer.report
        row: dict[str, Any] = {"session": each.number}
        for kind in ("added", "removed", "moved", "reshaped"):
            row[kind] = None if report is None else sum(item.kind == kind for item in report.objects)
        if report is not None:
            row["moved"] //= 2  # both halves of a move
        scored = None if each.score is None or report is None else each.score.objects
        row["false"] = None if scored is None else sum(item["outcome"] == "false" for item in scored)
        rows.append(row)
    return pd.DataFrame(rows)


def _changes_by_prop(comparison: Comparison) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for row in [] if comparison.score is None else comparison.score.changes:
        found.setdefault(row["name"], []).append(row)
    return found


def _judge(rows: Sequence[dict[str, Any]], comparison: Comparison) -> dict[str, Any]:
    nothing = {"is_observable": False, "answered_kind": "", "iou_point": float("nan")}
    if not rows:
        return {"true_kind": UNCHANGED, **nothing, "verdict": ""}
    told = {"true_kind": rows[0]["kind"]}
    seen = [row for row in rows if row["is_observable"]]
    if comparison.answer.report is None:
        return told | nothing | {"is_observable": bool(seen), "verdict": NO_ANSWER}
    if not seen:
        return told | nothing | {"verdict": HIDDEN}
    found = [row for row in seen if row["matched_object"] >= 0]
    answered = "/".join(dict.fromkeys(row["matched_kind"] for row in found))
    verdict = MISSED if not found else OTHER_KIND
    if len(found) == len(seen) and all(row["is_kind_right"] == 1 for row in found):
        verdict = RIGHT
    worst = min((row["iou_point"] for row in seen), default=float("nan"))
    return told | {"is_observable": True, "answered_kind": answered, "iou_point": worst, "verdict": verdict}
