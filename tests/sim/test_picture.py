from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scenarios.schema import Prop, Scenario
from sim.picture import render
from sim.scene import build_world


def test_a_picture_shows_the_prop_in_front_of_rock_and_highlights_it(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    world = build_world(make_scenario(props=(make_prop("box", 0.4, 0.0, change="added"),)), 0)
    eye, target = (5.0, 0.0, 0.5), (8.0, 0.0, 0.3)
    empty = render(world.before, eye, target, 120, 90).astype(int)
    plain, red = (render(world.after, eye, target, 120, 90, highlight=h).astype(int) for h in ((), (1,)))
    assert plain.shape == (90, 120, 3)
    differs = (plain != empty).any(axis=2)
    # The box, 0.6 m wide, stands 2.6 m before the lens, whose picture is 2 tan(35 deg) times its distance wide.
    width_px = 120 * 0.6 / (2 * np.tan(np.deg2rad(35)) * 2.6)
    assert abs(differs[45].sum() - width_px) <= 2
    np.testing.assert_array_equal((red != plain).any(axis=2), differs)
    assert (red[differs, 0] > 2 * red[differs, 1]).all()
