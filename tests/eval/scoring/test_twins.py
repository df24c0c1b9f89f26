"""Which of several equal props went where: an answer is judged by the labelling that suits it best."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose
from cdpipe.io.answer import Answer
from cdpipe.model.report import ChangedObject
from eval.scoring.object_metrics import judge_kinds, match_objects
from eval.scoring.object_sizes import compute_size_errors, find_true_displacements_map
from eval.scoring.scoring import score_answer
from eval.scoring.twins import Label, label_changes, list_drawn_labels, list_twins
from eval.truth.ground_truth import GroundTruth
from sim.session.truth import Change
from tests.eval.scoring.test_object_sizes import WIDTH, change_at, thing, truth_of

NAN = float("nan")


def prop(name: str, height_m: float = 0.9, **fields: object) -> dict[str, Any]:
    return {"name": name, "size_m": [0.58, 0.58, height_m], **fields}


def at(x_m: float) -> np.ndarray:
    return make_pose(translation=(x_m, 0.0, 0.0))


def gone(number: int, name: str, x_m: float, kind: str = "removed", **fields: object) -> Change:
    return change_at(number, "before", kind, at(x_m), **{"name": name, "prop_kind": "barrel", **fields})


def come(number: int, name: str, x_m: float, kind: str = "added", **fields: object) -> Change:
    return change_at(number, "after", kind, at(x_m), **{"name": name, "prop_kind": "barrel", **fields})


def carried(number: int, name: str, x_m: float, to_m: float, **fields: object) -> list[Change]:
    return [
        gone(number, name, x_m, "moved", partner=number + 1, **fields),
        come(number + 1, name, to_m, "moved", partner=number, **fields),
    ]


def answer(truth: GroundTruth, links: list[tuple[int, int]]) -> list[ChangedObject]:
    """One object on each change, in their order; linked ones are moved, the others are what their session says."""
    partner = {i: j for r, a in links for i, j in ((r, a), (a, r))}
    return [
        replace(
            thing(change.session, moved_by=(1.0, 0.0, 0.0) if index in partner else None),
            kind="moved" if index in partner else {"before": "removed", "after": "added"}[change.session],
            partner=partner.get(index, -1),
        )
        for index, change in enumerate(truth.pair.changes)
    ]


def judged(truth: GroundTruth, objects: list[ChangedObject], missing: tuple[int, ...] = ()) -> list[float]:
    return judge_kinds(objects, matched(truth, objects, missing), truth).tolist()


def matched(truth: GroundTruth, objects: list[ChangedObject], missing: tuple[int, ...] = ()) -> Any:
    places = {"before": 0, "after": 0}
    rows = []
    for index, change in enumerate(truth.pair.changes):
        first = places[change.session] * WIDTH
        places[change.session] += 1
        rows.append(np.arange(first, first + WIDTH) if index not in missing else np.zeros(0, np.int64))
    return match_objects(objects, rows, truth)


def two_barrels(height_m: float = 0.9, **fields: object) -> GroundTruth:
    """The barrel A went from 2 to 12 m; B was taken away from 11 m, beside the place to which A came."""
    changes = [*carried(1, "A", 2.0, 12.0), gone(3, "B", 11.0, **fields)]
    return truth_of(changes, props=[prop("A"), prop("B", height_m)])


def test_of_two_equal_barrels_either_may_have_been_carried() -> None:
    truth = two_barrels()
    assert judged(truth, answer(truth, [(0, 1)])) == [1.0, 1.0, 1.0]
    objects = answer(truth, [(2, 1)])
    assert judged(truth, objects) == [1.0, 1.0, 1.0]
    # and its way is that from the place at which it is said to have stood: 1 m
    errors = compute_size_errors(objects, matched(truth, objects), truth)
    np.testing.assert_allclose(errors.displacement_m, [NAN, 0.0, 0.0], atol=1e-9)
    errors = compute_size_errors(answer(truth, [(0, 1)]), matched(truth, answer(truth, [(0, 1)])), truth)
    np.testing.assert_allclose(errors.displacement_m, [9.0, 9.0, NAN], atol=1e-9)


def test_the_changes_among_which_labels_are_exchanged_are_listed() -> None:
    assert list_twins(two_barrels()) == [[2, 3], [1, 3], [1, 2]]
    assert list_twins(two_barrels(height_m=0.5)) == [[], [], []]  # A's own two halves are no twins
    changes = [gone(4, "A", 2.0), come(7, "B", 9.0), gone(8, "C", 5.0)]
    truth = truth_of(changes, props=[prop("A"), prop("B"), prop("C", 0.5)])
    assert list_twins(truth) == [[7], [4], []]
    # the two halves of a move have no twin, whatever stands after them
    changes = [*carried(1, "C", 20.0, 25.0), gone(4, "A", 2.0), come(7, "B", 9.0)]
    truth = truth_of(changes, props=[prop("A"), prop("B"), prop("C", 0.5)])
    assert list_twins(truth) == [[], [], [7], [4]]


def test_the_row_of_a_change_names_its_twins() -> None:
    case = score_answer(Answer("failed", "too dark", "mine", None, {}, {}), two_barrels())
    assert [row["twins"] for row in case.changes] == ["2;3", "1;3", "1;2"]


def test_one_of_them_was_carried_all_the_same() -> None:
    truth = two_barrels()
    # all three are said to stand alone: the one that came was carried, and so was one of the two that are gone
    assert judged(truth, answer(truth, [])) == [0.0, 0.0, 1.0]
    # a link that only one half states, and a link with itself, are as wrong as among others
    objects = answer(truth, [(2, 1)])
    half = [*objects[:2], replace(objects[2], partner=-1)]
    assert judged(truth, half) == [1.0, 1.0, 0.0]


@pytest.mark.parametrize(("height_m", "are_twins"), [(0.949, True), (0.851, True), (0.950005, False), (0.848, False)])
def test_twins_differ_by_half_a_cell_at_most(height_m: float, are_twins: bool) -> None:
    truth = two_barrels(height_m)
    assert judged(truth, answer(truth, [(2, 1)])) == ([1.0, 1.0, 1.0] if are_twins else [0.0, 0.0, 0.0])
    assert judged(truth, answer(truth, [(0, 1)])) == [1.0, 1.0, 1.0]


def test_other_kinds_and_shapes_of_their_own_are_no_twins() -> None:
    swapped = [(2, 1)]
    for fields in ({"prop_kind": "crate"}, {"group": "partial"}):
        truth = two_barrels(**fields)
        assert judged(truth, answer(truth, swapped)) == [0.0, 0.0, 0.0]
    for kind, right in (("rock", 0.0), ("muck_pile", 0.0), ("pallet", 1.0)):
        changes = [*carried(1, "A", 2.0, 12.0, prop_kind=kind), gone(3, "B", 11.0, prop_kind=kind)]
        truth = truth_of(changes, props=[prop("A"), prop("B")])
        assert judged(truth, answer(truth, swapped)) == [right] * 3
    # props of which nothing is known
    truth = truth_of([*carried(1, "A", 2.0, 12.0), gone(3, "B", 11.0)], props=[prop("A")])
    assert judged(truth, answer(truth, swapped)) == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("file", "right"), [("a.glb", 1.0), ("b.glb", 0.0)])
def test_foreign_props_of_one_file_are_twins(file: str, right: float) -> None:
    changes = [*carried(1, "A", 2.0, 12.0, prop_kind="mesh"), gone(3, "B", 11.0, prop_kind="mesh")]
    meshes = [{"name": name, "size_m": None, "mesh": {"file": each}} for name, each in (("A", "a.glb"), ("B", file))]
    truth = truth_of(changes, props=meshes)
    assert judged(truth, answer(truth, [(2, 1)])) == [right] * 3


def test_a_short_move_is_that_of_one_prop_alone() -> None:
    # half a crate's length: what was hidden by the other half tells which one it was
    changes = [*carried(1, "A", 2.0, 2.4, group="partial"), gone(3, "B", 11.0)]
    truth = truth_of(changes, props=[prop("A"), prop("B")])
    assert judged(truth, answer(truth, [(0, 1)])) == [1.0, 1.0, 1.0]
    assert judged(truth, answer(truth, [(2, 1)])) == [0.0, 0.0, 0.0]


def test_one_that_went_and_an_equal_one_that_came_may_be_one_that_moved() -> None:
    truth = truth_of([gone(1, "A", 2.0), come(2, "B", 12.0)], props=[prop("A"), prop("B")])
    assert judged(truth, answer(truth, [(0, 1)])) == [1.0, 1.0]
    assert judged(truth, answer(truth, [])) == [1.0, 1.0]
    labels = label_changes(answer(truth, []), np.array([0, 1]), truth)
    assert labels == list_drawn_labels(truth) == (Label("removed", -1), Label("added", -1))
    # but not the other way round: one that moved did not vanish
    truth = truth_of(carried(1, "A", 2.0, 12.0), props=[prop("A")])
    assert judged(truth, answer(truth, [])) == [0.0, 0.0]


def test_without_an_object_on_them_labels_are_as_drawn() -> None:
    truth = two_barrels()
    none = label_changes([], np.full(3, -1), truth)
    assert none == list_drawn_labels(truth) == (Label("moved", 1), Label("moved", 0), Label("removed", -1))
    np.testing.assert_allclose(find_true_displacements_map(truth), [[10, 0, 0], [10, 0, 0], [NAN] * 3], atol=1e-9)
    # an object of another kind does not change that; what nobody answered is not judged
    assert judged(truth, answer(truth, [(0, 1)]), missing=(0,)) == pytest.approx([NAN, 0.0, 1.0], nan_ok=True)
    assert judged(truth, answer(truth, [(2, 1)]), missing=(0,)) == pytest.approx([NAN, 1.0, 1.0], nan_ok=True)


def test_a_half_that_nobody_could_see_may_be_left_out_among_twins_too() -> None:
    changes = [*carried(1, "A", 2.0, 12.0), gone(3, "B", 11.0)]
    changes[1] = replace(changes[1], is_observable=False)
    truth = truth_of(changes, props=[prop("A"), prop("B")])
    truth = replace(truth, is_observable=np.array([True, False, True]))
    assert judged(truth, answer(truth, [])) == pytest.approx([1.0, NAN, 1.0], nan_ok=True)


def test_twins_of_twins_are_one_group() -> None:
    # B is a twin of A and of C, which are none of each other: links go between twins alone
    heights_m = {"A": 0.86, "B": 0.90, "C": 0.94}
    changes = [*carried(1, "A", 2.0, 4.0), *carried(3, "B", 8.0, 10.0), *carried(5, "C", 14.0, 16.0)]
    truth = truth_of(changes, props=[prop(name, height_m) for name, height_m in heights_m.items()])
    assert judged(truth, answer(truth, [(0, 3), (2, 1), (4, 5)])) == [1.0] * 6
    assert judged(truth, answer(truth, [(0, 1), (2, 5), (4, 3)])) == [1.0] * 6
    # A's place to C's: B alone fits what is left
    # two links that leave A's and C's ends to one another cannot both be
    assert sum(judged(truth, answer(truth, [(0, 3), (2, 5)]))) == 2.0
    right = judged(truth, answer(truth, [(0, 5), (4, 1), (2, 3)]))
    assert (right[0], right[5], right[2], right[3]) == (0.0, 0.0, 1.0, 1.0)


def test_a_move_without_a_partner_is_no_link_with_what_was_missed() -> None:
    truth = truth_of(carried(1, "A", 2.0, 12.0), props=[prop("A")])
    alone = [replace(each, partner=-1) for each in answer(truth, [(0, 1)])]
    assert judged(truth, alone, missing=(1,)) == pytest.approx([0.0, NAN], nan_ok=True)


def test_only_halves_of_moves_are_linked_as_drawn() -> None:
    changes = [gone(1, "A", 2.0, partner=2), come(2, "A", 5.0, partner=9), come(3, "B", 5.0, "moved", partner=9)]
    assert list_drawn_labels(truth_of(changes)) == (Label("removed", -1), Label("added", -1), Label("moved", -1))


def test_what_is_left_of_twins_is_judged_as_left() -> None:
    # A went to 12 m or to 14 m; what it says of its end fits 14 m, what the thing at 14 m says of itself fits 12 m
    changes = [*carried(1, "A", 2.0, 12.0), come(3, "B", 14.0)]
    truth = truth_of(changes, props=[prop("A"), prop("B")])
    objects = answer(truth, [(0, 2)])
    objects[2] = replace(objects[2], kind="added", partner=-1)
    objects[1] = replace(objects[1], kind="moved", partner=1)
    # both fit one object; then the scenario's own labels count
    assert judged(truth, objects) == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("drawn_alone", [0, 1, 2])
def test_of_labels_that_fit_equally_well_those_of_the_scenario_count(drawn_alone: int, is_reversed: bool) -> None:
    """Two twins went to two of three places, and one came; with `is_reversed` the other way round in time.

    The answer links the first place left with the first of the places that are reached, against the scenario, and says
    of the second and the third place that something came there alone: one of both is right.
    """
    one, other = (come, gone) if is_reversed else (gone, come)
    names = ["A", "B", "C"]
    reached = [place for place in range(3) if place != drawn_alone]
    places = [other(3 + place, names[place], 20.0 + 2 * place) for place in range(3)]
    lefts = [one(1, names[reached[0]], 2.0), one(2, names[reached[1]], 4.0)]
    for row, place in enumerate(reached):
        lefts[row] = replace(lefts[row], kind="moved", partner=3 + place)
        places[place] = replace(places[place], kind="moved", partner=1 + row)
    truth = truth_of([*lefts, *places], props=[prop(name) for name in names])
    # crosswise: the first left place with the end of the second
    objects = answer(truth, [(0, 2 + reached[1])])
    alone = [drawn_alone, reached[0]]
    right = judged(truth, objects)
    assert (right[0], right[1], right[2 + reached[1]]) == (1.0, 0.0, 1.0)
    assert [right[2 + place] for place in alone] == [1.0, 0.0]
