"""Rings that lie apart are told from a covered surface."""

import numpy as np
import pytest

from cdpipe.merge.rings import MAX_LINE_SHARE, explain_rings, line_share


def tube(step_m: float) -> np.ndarray:
    """Rings of a tube of 3 m radius, a point for every 0.1 m, so many metres apart along x."""
    angle, along = np.meshgrid(np.linspace(0, 2 * np.pi, 190)[:-1], np.arange(0, 20, step_m))
    return np.column_stack([along.ravel(), 3 * np.cos(angle.ravel()), 3 * np.sin(angle.ravel())])


def test_rings_two_metres_apart_are_lines_and_those_of_a_fifth_are_a_surface() -> None:
    # an arc of 1 m to either side on a radius of 3 m bends by a sixth: its second spread is below a tenth of its first
    assert line_share(tube(2.0)) == 1.0
    # the share of lines depends on nothing but the shape: neither on the place nor on the order
    assert line_share(tube(2.0)[::-1] + 1000.0) == 1.0
    assert line_share(tube(0.2)) == 0.0
    both = np.concatenate([tube(0.2), tube(2.0) + np.array([100.0, 0.0, 0.0])])
    assert line_share(both) == pytest.approx(len(tube(2.0)) / len(both), abs=0.02)


def test_single_points_have_no_surface() -> None:
    assert line_share(np.zeros((0, 3))) == 1.0
    assert line_share(np.arange(30.0).reshape(10, 3) * 100) == 1.0


def test_the_refusal_names_the_share_and_the_way_out() -> None:
    assert explain_rings({}) == explain_rings({"line_share": MAX_LINE_SHARE}) == ""
    reason = explain_rings({"line_share": 0.33})
    assert "33%" in reason and "ten metres" in reason and "--before-T-after" in reason
