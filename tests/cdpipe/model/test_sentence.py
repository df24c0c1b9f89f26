"""The sentence of an answer, by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, Coverage, SurfaceField, SurfaceRegion
from cdpipe.model.sentence import moved_m

NONE = ChangeRegions(np.zeros((0, 3)), 4.5, np.zeros(0), np.zeros((0, 2), int), np.zeros(0, bool), np.zeros(0))
EMPTY = ChangeReport(np.eye(4), {}, NONE, (), {}, {}, (np.zeros(0, np.int64), np.zeros(0, np.int64)))


def thing(kind: Any, session: Any = "after", partner: int = -1, x_m: float = 0.0, **more: Any) -> ChangedObject:
    points = np.array([[x_m, 0.0, 0.0], [x_m + 1.0, 0.0, 0.0]])
    return ChangedObject(session, kind, 0, np.zeros((0, 2), np.int32), points, 1.0, partner, **more)


def covered(compared_m: float, unseen_m: float, is_near: bool = True) -> Coverage:
    return Coverage(compared_m, unseen_m, np.array([is_near]))


def test_a_moved_object_counts_once_and_says_how_far() -> None:
    shift = {"displacement_map": np.array([0.0, 2.3, 0.0])}
    objects = (
        *[thing("added")] * 5, thing("moved", "before", 6, **shift), thing("moved", "after", 5, **shift),
        *[thing("removed", "before")] * 2,
    )  # fmt: skip
    report = replace(EMPTY, objects=objects, coverage=covered(409.7, 35.2))
    assert str(report) == "5 added, 1 moved 2.3 m, 2 removed; 410 m compared, 35 m not seen"


def test_several_moved_objects_say_the_nearest_and_the_farthest_way() -> None:
    # without a displacement: between the means of both places, 4 m; the third has lost its partner
    objects = (
        thing("moved", "before", 1, x_m=1.0), thing("moved", "after", 0, x_m=5.0),
        thing("moved", "before", 3, displacement_map=np.array([0.6, 0.0, 0.8])), thing("moved", "after", 2),
        thing("moved", "after"),
    )  # fmt: skip
    assert moved_m(objects[0], objects) == 4.0
    assert np.isnan(moved_m(objects[4], objects))
    assert str(replace(EMPTY, objects=objects)) == "3 moved 1.0 to 4.0 m"
    assert str(replace(EMPTY, objects=objects[4:])) == "1 moved"
    assert str(replace(EMPTY, objects=(replace(objects[4], partner=99),))) == "1 moved"


@pytest.mark.parametrize(
    ("coverage", "told"),
    [
        (None, "no change found"),
        (covered(0.0, 12.0, False), "no change found; 0 m compared, 12 m not seen"),
        (covered(0.1, 0.0), "no change found; one place compared"),
        (covered(0.0, 0.0, False), "no change found; one place not seen"),
    ],
)
def test_without_changes(coverage: Coverage | None, told: str) -> None:
    assert str(replace(EMPTY, coverage=coverage)) == told


def test_regions_without_an_object_were_looked_at() -> None:
    none = np.zeros(3, bool)
    three = ChangeRegions(np.zeros((3, 3)), 4.5, np.ones(3), np.zeros((3, 2), int), none, np.zeros(0))
    assert str(replace(EMPTY, regions=three)) == "no change found"
    two = replace(three, is_withdrawn=np.array([True, True, False]))
    assert str(replace(EMPTY, regions=two)) == "no change found in 2 regions looked at"
    one = replace(three, is_withdrawn=np.array([True, False, False]))
    assert str(replace(EMPTY, regions=one)) == "no change found in 1 region looked at"


def test_regions_count_where_there_are_no_objects() -> None:
    two = ChangeRegions(
        np.zeros((2, 3)), 4.5, np.array([2.0, 1.0]), np.zeros((2, 2), int), np.array([True, False]), np.zeros(0)
    )
    assert str(replace(EMPTY, regions=two)) == "1 changed region"
    assert str(replace(EMPTY, regions=replace(two, is_reported=np.ones(2, bool)))) == "2 changed regions"
    assert str(replace(EMPTY, regions=two, objects=(thing("reshaped", "before"),))) == "1 reshaped"


def test_rock_says_its_places_and_the_largest_displacement() -> None:
    regions = tuple(SurfaceRegion(np.zeros(3), 1.0, 0.1, 0.02, largest_m) for largest_m in (0.03, -0.234))
    nothing = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0, np.int32)
    report = replace(EMPTY, surface=SurfaceField(*nothing, regions=regions), objects=(thing("added"),))
    assert str(report) == "1 added, rock moved at 2 places by up to 234 mm"
    assert str(replace(report, surface=SurfaceField(*nothing))) == "1 added"
