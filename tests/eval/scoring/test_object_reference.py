"""Every object metric again, slowly and plainly from its definition, on random answers to random truths."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import stream
from cdpipe.model.report import ChangedObject
from eval.scoring.object_metrics import judge_kinds, match_objects, summarise_objects
from eval.truth.ground_truth import GroundTruth, SessionTruth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import Change, PairTruth
from tests.eval.changes import change

N_ROWS = 90
SESSIONS = ("before", "after")
NAN = float("nan")


class Case:
    """A random truth of up to six changes in two sessions, and a random answer of up to eight objects."""

    def __init__(self, seed: int) -> None:
        draw = stream(seed, "object reference")
        self.changes = self._changes(draw)
        scoring_points = {}
        for session in SESSIONS:
            ids = [0, *(change.id for change in self.changes if change.session == session)]
            points = draw.uniform(0.0, 1.2, (N_ROWS, 3)).astype(np.float32)
            # things are lumps of the cloud, not salt and pepper
            owner = np.array(ids)[np.digitize(points[:, 0], np.sort(draw.uniform(0, 1.2, len(ids) - 1)))]
            zeros = np.zeros(N_ROWS, dtype=np.int16)
            scoring_points[session] = ScoringPoints(
                np.arange(N_ROWS, dtype=np.int64), points, owner.astype(np.int16), zeros, 1, N_ROWS
            )
        self.truth = GroundTruth(
            pair=PairTruth("test", 0, 4.5, tuple(self.changes), {"props": self._props(seed)}),
            sessions={name: SessionTruth(np.eye(4)[None], np.eye(4)[None], scoring_points[name]) for name in SESSIONS},
            change_rows=tuple(scoring_points[change.session].rows_of_change(change.id) for change in self.changes),
            centroids_world=np.zeros((len(self.changes), 3)),
            is_observable=np.array([change.is_observable for change in self.changes]),
            is_partial=np.array([change.group == "partial" for change in self.changes]),
        )
        self.objects, self.rows = self._answer(draw, scoring_points)

    def _changes(self, draw: np.random.Generator) -> list[Change]:
        changes = []
        for number in range(1, int(draw.integers(2, 7)) + 1):
            kind = str(draw.choice(["added", "removed", "moved", "reshaped"]))
            session = {"added": "after", "removed": "before", "reshaped": "before"}.get(
                kind, str(draw.choice(SESSIONS))
            )
            group = "partial" if kind == "reshaped" or (kind == "moved" and draw.random() < 0.3) else "full"
            partner = None
            if kind == "moved":
                free = [c for c in changes if c.kind == "moved" and c.session != session and c.partner is None]
                partner = free[0].id if free else None
                changes = [replace(c, partner=number) if c.id == partner else c for c in changes]
            is_observable = bool(draw.random() < 0.8)
            changes.append(change(number, session, kind, partner=partner, group=group, is_observable=is_observable))
        return changes

    def _props(self, seed: int) -> list[dict[str, object]]:
        draw = stream(seed, "object reference", "props")
        widths_m = (0.5, 0.54, 0.62)  # the first two are twins
        return [{"name": c.name, "size_m": [float(draw.choice(widths_m)), 0.5, 0.5]} for c in self.changes]

    def _answer(
        self, draw: np.random.Generator, scoring_points: dict[str, ScoringPoints]
    ) -> tuple[list[ChangedObject], list[np.ndarray]]:
        objects, rows = [], []
        for session in SESSIONS:
            n_objects = int(draw.integers(0, 5))
            edges = np.sort(draw.uniform(0, 1.2, n_objects))
            owner = np.digitize(scoring_points[session].points_odom[:, 0], edges)
            owner[draw.random(N_ROWS) < 0.2] = 0  # some rows are nobody's
            for number in range(1, n_objects + 1):
                kind = str(draw.choice(["added", "removed", "moved", "reshaped"]))
                rows.append(np.flatnonzero(owner == number))
                objects.append(ChangedObject(session, kind, 0, np.zeros((0, 2), np.int32), np.zeros((0, 3)), 1.0))
        partners = draw.permutation(len(objects))
        return [
            ChangedObject(
                o.session, o.kind, 0, o.returns, o.points_map, 1.0, int(partners[i]) if o.kind == "moved" else -1
            )
            for i, o in enumerate(objects)
        ], rows


def set_iou(a: set[object], b: set[object]) -> float:
    return len(a & b) / len(a | b) if a | b else 0.0


def slow_point_iou(case: Case, change: int, item: int) -> float:
    return set_iou(set(case.truth.change_rows[change].tolist()), set(case.rows[item].tolist()))


def slow_voxel_iou(case: Case, change: int, item: int) -> float:
    points = case.truth.sessions[case.changes[change].session].scoring_points.points_odom.astype(np.float64)
    found = []
    for shift in itertools.product((0.0, 0.05), repeat=3):
        cells = [
            {tuple(int(np.floor((points[row][axis] + shift[axis]) / 0.1)) for axis in range(3)) for row in rows}
            for rows in (case.truth.change_rows[change], case.rows[item])
        ]
        found.append(set_iou(*cells))
    return sum(found) / 8


def slow_box_iou(case: Case, change: int, item: int) -> float:
    points = case.truth.sessions[case.changes[change].session].scoring_points.points_odom.astype(np.float64)
    shared = volume_a = volume_b = 1.0
    for axis in range(3):
        a, b = ([points[row][axis] for row in rows] for rows in (case.truth.change_rows[change], case.rows[item]))
        shared *= max(0.0, min(max(a), max(b)) - max(min(a), min(b)) + 0.1)
        volume_a *= max(a) - min(a) + 0.1
        volume_b *= max(b) - min(b) + 0.1
    return shared / (volume_a + volume_b - shared)


def pairings(case: Case, changes: Sequence[int], taken: frozenset[int] = frozenset()) -> Iterator[dict[int, int]]:
    """Yield every way to give some changes one object each that overlaps them, none twice."""
    if not changes:
        yield {}
        return
    first, rest = changes[0], changes[1:]
    yield from pairings(case, rest, taken)
    for item, answered in enumerate(case.objects):
        if (
            item not in taken
            and answered.session == case.changes[first].session
            and slow_point_iou(case, first, item) > 0
        ):
            for others in pairings(case, rest, taken | {item}):
                yield {first: item, **others}


def slow_matching(case: Case) -> dict[int, int] | None:
    """Return the pairing with the largest sum of point IoU; None where two are equally good."""
    observable = [index for index, change in enumerate(case.changes) if case.truth.is_observable[index]]
    sums = [(sum(slow_point_iou(case, *pair) for pair in ways.items()), ways) for ways in pairings(case, observable)]
    best = max(total for total, _ in sums)
    winners = [ways for total, ways in sums if total > best - 1e-12]
    return winners[0] if len(winners) == 1 else None


def slow_kind_right(case: Case, matching: dict[int, int], change: int, kind: str, other: int | None) -> float:
    truth, item = case.changes[change], case.objects[matching[change]]
    if kind != "moved" or other is None:
        return float(item.kind == kind)
    if not case.truth.is_observable[other]:
        return float(item.kind == "moved" or item.kind == {"after": "added", "before": "removed"}[truth.session])
    return float(item.kind == "moved" and other in matching and item.partner == matching[other])


def drawn_half(case: Case, change: int) -> int | None:
    return next((i for i, each in enumerate(case.changes) if each.id == case.changes[change].partner), None)


def links(case: Case) -> list[tuple[int, int]]:
    """Return every before and after that may be one object: both whole, and twins or halves of one move."""
    widths_m = [prop["size_m"][0] for prop in case.truth.pair.scenario["props"]]

    def is_free(i: int) -> bool:
        half = drawn_half(case, i)
        is_whole = case.changes[i].group == "full" and (half is None or case.changes[half].group == "full")
        return is_whole and (half is not None or case.changes[i].kind in ("added", "removed"))

    free = [i for i in range(len(case.changes)) if is_free(i)]
    return [
        (r, a)
        for r in free
        for a in free
        if (case.changes[r].session, case.changes[a].session) == SESSIONS
        and (drawn_half(case, r) == a or abs(widths_m[r] - widths_m[a]) <= 0.05)
    ]


def labellings(case: Case) -> Iterator[dict[int, int]]:
    """Yield every choice of links, none twice at an end, with as many moves in each group as were drawn, or more."""
    all_links = links(case)
    group = {i: i for link in all_links for i in link}
    for _ in all_links:
        for r, a in all_links:
            group[r] = group[a] = min(group[r], group[a])
    drawn = [group[r] for r, a in all_links if drawn_half(case, r) == a]
    for n in range(len(all_links) + 1):
        for chosen in itertools.combinations(all_links, n):
            ends = [end for link in chosen for end in link]
            made = [group[r] for r, _ in chosen]
            if len(set(ends)) == len(ends) and all(made.count(each) >= drawn.count(each) for each in drawn):
                yield {i: j for r, a in chosen for i, j in ((r, a), (a, r))}


def slow_kinds_right(case: Case, matching: dict[int, int]) -> float:
    """Return the number of right kinds under the labelling that suits the answer best."""
    free = {end for link in links(case) for end in link}
    fixed = sum(
        slow_kind_right(case, matching, i, case.changes[i].kind, drawn_half(case, i)) for i in matching if i not in free
    )

    def value(halves: dict[int, int]) -> float:
        alone = {"after": "added", "before": "removed"}
        return sum(
            slow_kind_right(
                case, matching, i, "moved" if i in halves else alone[case.changes[i].session], halves.get(i)
            )
            for i in matching
            if i in free
        )

    return fixed + max(value(halves) for halves in labellings(case))


def slow_columns(case: Case, matching: dict[int, int]) -> dict[str, float]:
    main = [i for i, c in enumerate(case.changes) if case.truth.is_observable[i] and c.group == "full"]
    partial = [i for i, c in enumerate(case.changes) if case.truth.is_observable[i] and c.group == "partial"]
    mean = {}
    for name, iou in (("point", slow_point_iou), ("voxel", slow_voxel_iou), ("box", slow_box_iou)):
        values = [iou(case, change, matching[change]) if change in matching else 0.0 for change in main]
        mean[f"object_iou_{name}"] = sum(values) / len(values) if values else NAN
    elsewhere = {
        (change.session, row)
        for index, change in enumerate(case.changes)
        if index not in main
        for row in case.truth.change_rows[index].tolist()
    }

    def scores(threshold: float) -> tuple[float, float, float]:
        hits = {c: matching[c] for c in main if c in matching and slow_point_iou(case, c, matching[c]) >= threshold}
        n_false = 0
        for item, answered in enumerate(case.objects):
            on_others = sum((answered.session, row) in elsewhere for row in case.rows[item].tolist())
            n_false += item not in hits.values() and not on_others > len(case.rows[item]) / 2
        n_missed = len(main) - len(hits)
        weight = len(hits) + (n_false + n_missed) / 2
        precision = len(hits) / (len(hits) + n_false) if len(hits) + n_false else 0.0 if main else NAN
        if not main:
            return NAN, precision, NAN
        return len(hits) / weight, precision, sum(slow_point_iou(case, *pair) for pair in hits.items()) / weight

    n_right = slow_kinds_right(case, matching)
    of_partial = [slow_point_iou(case, change, matching[change]) if change in matching else 0.0 for change in partial]
    return {
        **mean,
        "object_f1_25": scores(0.25)[0],
        "object_f1_50": scores(0.5)[0],
        "object_precision_50": scores(0.5)[1],
        "object_pq": scores(0.5)[2],
        "kind_accuracy": n_right / len(matching) if matching else (0.0 if any(case.truth.is_observable) else NAN),
        "object_iou_point_partial": sum(of_partial) / len(of_partial) if of_partial else NAN,
    }


@pytest.mark.parametrize("seed", range(40))
def test_every_object_metric_equals_its_slow_twin(seed: int) -> None:
    case = Case(seed)
    matching = slow_matching(case)
    if matching is None:
        # no draw of these seeds ties; a new one would have to be left out by name, not in silence
        pytest.fail(f"seed {seed} has two matchings that are equally good")
    matches = match_objects(case.objects, case.rows, case.truth)
    assert {c: int(o) for c, o in enumerate(matches.matched_object) if o >= 0} == matching
    columns = summarise_objects(matches, judge_kinds(case.objects, matches, case.truth), case.truth)
    expected = slow_columns(case, matching)
    assert {name: columns[name] for name in expected} == pytest.approx(expected, nan_ok=True, abs=1e-9)


def test_the_random_cases_reach_every_branch() -> None:
    cases = [Case(seed) for seed in range(40)]
    matchings = [slow_matching(case) for case in cases]
    columns = [
        slow_columns(case, matching) for case, matching in zip(cases, matchings, strict=True) if matching is not None
    ]
    for name in columns[0]:
        values = {round(each[name], 6) for each in columns if not np.isnan(each[name])}
        assert len(values) > 2, name
    halves = [c for case in cases for c in case.changes if c.kind == "moved" and c.partner is not None]
    assert len(halves) > 5
    assert any(not all(case.truth.is_observable) for case in cases)


def relinked(case: Case, seed: int) -> Case:
    """Link objects of both sessions at random, both halves with one another; the others stand alone."""
    draw = stream(seed, "object reference", "links")
    before, after = (
        draw.permutation([i for i, item in enumerate(case.objects) if item.session == session]) for session in SESSIONS
    )
    n = int(draw.integers(0, min(len(before), len(after)) + 1))
    partner = {int(i): int(j) for r, a in zip(before[:n], after[:n], strict=True) for i, j in ((r, a), (a, r))}
    alone = {"before": "removed", "after": "added"}
    case.objects = [
        replace(item, kind="moved" if i in partner else alone[item.session], partner=partner.get(i, -1))
        for i, item in enumerate(case.objects)
    ]
    return case


def test_kinds_among_twins_equal_their_slow_twin_and_not_the_drawn_labels() -> None:
    n_others = 0
    for seed in range(200):
        case = relinked(Case(seed), seed)
        matching = slow_matching(case)
        if matching is None:
            continue
        matches = match_objects(case.objects, case.rows, case.truth)
        right = judge_kinds(case.objects, matches, case.truth)
        assert np.nansum(right) == slow_kinds_right(case, matching)
        as_drawn = [
            slow_kind_right(case, matching, i, case.changes[i].kind, drawn_half(case, i)) if i in matching else NAN
            for i in range(len(case.changes))
        ]
        n_others += sum(as_drawn[i] for i in matching) < np.nansum(right)
    assert n_others > 5
