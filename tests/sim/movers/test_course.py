from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from sim.movers.mover import MovingBody

MakeBody = Callable[..., MovingBody]


def headings(poses: Float64Array) -> Float64Array:
    return np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


def test_a_walker_goes_to_and_fro_at_its_speed_and_faces_where_it_goes(make_body: MakeBody) -> None:
    body = make_body("person", speed_mps=1.0, pause_s=2.0)
    course = body.course
    assert course.period_s == pytest.approx(24.0)
    along_m, turned = course.find_place(np.array([0.0, 4.0, 10.0, 11.0, 12.0, 16.0, 22.0, 23.0, 24.0, 28.0]))
    np.testing.assert_allclose(along_m, [0, 4, 10, 10, 10, 6, 0, 0, 0, 4], atol=1e-9)
    np.testing.assert_allclose(turned, [0, 0, 0, 0.5, 1, 1, 1, 0.5, 0, 0], atol=1e-6)
    time_s = np.linspace(0.0, 48.0, 4801)
    poses = body.world_T_root(time_s)
    step = np.diff(poses[:, :2, 3], axis=0) / 0.01
    speed = np.linalg.norm(step, axis=1)
    assert speed.max() < 1.02
    is_going = speed > 0.9
    facing = (step * poses[:-1, :2, 0]).sum(axis=1)
    assert facing[is_going].min() > 0.9
    assert np.abs(np.diff(headings(poses))).max() < 0.03  # it turns round while it pauses, in no jump


def test_a_machine_comes_back_backwards_with_its_load_up(make_body: MakeBody) -> None:
    body = make_body("forklift", speed_mps=2.0, pause_s=4.0)
    there, back = np.array([2.0]), np.array([11.5])
    np.testing.assert_allclose(body.world_T_root(there)[0, :3, 3], body.world_T_root(np.array([9 + 3.0]))[0, :3, 3])
    assert np.ptp(headings(body.world_T_root(np.linspace(0, 36, 500)))) < 0.05 * 10 + 0.01  # only its line bends
    forks = [body.figure.body.place_links(body.course.moment(at))[1, 0, 2, 3] for at in (there, back)]
    assert forks == pytest.approx([0.0, 0.4 * 2.1], abs=1e-6)


def test_a_body_that_stays_is_always_there_and_a_standing_person_sways(make_body: MakeBody) -> None:
    time_s = np.linspace(0.0, 60.0, 200)
    body = make_body("person", speed_mps=0)
    assert not body.course.is_moving
    assert np.ptp(body.world_T_root(time_s)[:, :3, 3], axis=0).max() == 0.0
    assert (body.course.moment(time_s).activity == 0).all()
    fore = body.world_T_links(time_s)[-1]
    assert np.ptp(fore[:, :3, 2], axis=0).max() > 0.05  # a forearm moves


def test_time_goes_on_between_recorded_revolutions(make_body: MakeBody) -> None:
    late, early = make_body("person", offset_s=3.5), make_body("person")
    np.testing.assert_allclose(late.world_T_links(np.array([1.0])), early.world_T_links(np.array([4.5])), atol=1e-12)


def test_a_body_passes_every_metre_of_its_way_out_and_back(make_body: MakeBody) -> None:
    course = make_body("forklift", speed_mps=2.5, pause_s=500.0).course
    along_m, turned = course.find_place(course.pass_times(1.1))
    np.testing.assert_allclose(along_m, [*np.arange(11.0), *np.arange(10.0, -1.0, -1.0)], atol=1e-9)
    np.testing.assert_allclose(turned, np.repeat([0.0, 1.0], 11), atol=1e-9)
