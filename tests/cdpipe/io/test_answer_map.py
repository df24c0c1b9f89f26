"""The map of an answer, joined from the maps of both sessions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from cdpipe.io.out.answer_map import _join
from cdpipe.io.out.clouds import write_laz
from cdpipe.io.out.maps import PointMap
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, SurfaceField

_NONE = np.zeros(0, np.int64)
_REGIONS = ChangeRegions(np.zeros((0, 3)), 3.0, np.zeros(0), np.zeros((0, 2), np.int64), np.zeros(0, np.bool_), _NONE)
_NOTHING = ChangeReport(np.eye(4), {}, _REGIONS, (), {}, {}, (_NONE, _NONE))


def cloud(points: Float64Array, **scalars: Any) -> PointMap:
    return PointMap(points, {"instance": np.zeros(len(points), np.int32), **scalars})


def along(*x_m: float) -> Float64Array:
    return np.array([[each, 0.0, 0.0] for each in x_m])


@pytest.mark.parametrize("order", [1, -1])
def test_values_of_one_session_are_nan_in_the_other(order: int, tmp_path: Path) -> None:
    rich = cloud(
        along(0, 1), intensity=np.array([3, 4], np.float32), ring=np.array([5, 6], np.uint16), time=np.array([1.5, 2.5])
    )
    both = (rich, cloud(along(0, 2, 3)))[::order]
    found = _join(both, _NOTHING)
    session = found.scalars["session"]
    for name in ("intensity", "ring", "time"):
        of_session = [found.scalars[name][session == number] for number in (0, 1)][::order]
        np.testing.assert_array_equal(of_session[0], rich.scalars[name])
        assert np.isnan(of_session[1]).all()
    assert found.scalars["instance"].dtype == np.int32
    laspy = pytest.importorskip("laspy", reason="pip install 'tunnelcd[formats]'")
    write_laz(tmp_path / "a.laz", found)
    read = laspy.read(tmp_path / "a.laz")
    is_poor = np.asarray(read.session) == (1 if order == 1 else 0)
    assert not np.asarray(read.intensity)[is_poor].any() and not np.asarray(read.gps_time)[is_poor].any()
    assert np.isnan(np.asarray(read.ring)[is_poor]).all()


def test_a_point_has_the_displacement_of_the_nearest_measured_place() -> None:
    """The place at 0.1 m was not measured; that at 0.25 m was."""
    places = along(0.1, 0.25, 9.0)
    displacement_m, nan = np.array([np.nan, 0.02, np.nan]), np.full(3, np.nan)
    field = SurfaceField(places, np.tile([0.0, 0, 1], (3, 1)), displacement_m, nan, np.full(3, -1, np.int32))
    points = along(0.1, 0.54, 0.56, 9.0)
    found = _join((cloud(points), cloud(points[:1])), replace(_NOTHING, surface=field))
    np.testing.assert_allclose(found.scalars["displacement"], [0.02, 0.02, np.nan, np.nan, 0.02])
    unmeasured = replace(field, displacement_m=nan)
    nothing = _join((cloud(points), cloud(points[:1])), replace(_NOTHING, surface=unmeasured))
    assert np.isnan(nothing.scalars["displacement"]).all()


def test_a_moved_object_has_the_length_of_its_way() -> None:
    item = ChangedObject("before", "moved", -1, np.zeros((0, 2), np.int32), along(0.0), 1.0)
    item = replace(item, displacement_map=np.array([3.0, 4.0, 0.0]))
    moved = cloud(along(0.0, 1.0), instance=np.array([1, 0], np.int32))
    found = _join((moved, cloud(along(1.0))), replace(_NOTHING, objects=(item,)))
    np.testing.assert_array_equal(found.scalars["displacement"], [5.0, np.nan, np.nan])
