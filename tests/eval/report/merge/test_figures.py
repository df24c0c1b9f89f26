import base64
import io

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from eval.report.merge import figures as merge_figures
from eval.report.merge.figures import _around_both, alignment_picture, surface_distances, worst_stretch


def pixels(address: str) -> np.ndarray:
    return imread(io.BytesIO(base64.b64decode(address.removeprefix("data:image/png;base64,"))))[..., :3]


def near(image: np.ndarray, colour: str) -> np.ndarray:
    return np.argwhere(np.abs(image - np.array(to_rgb(colour))).max(axis=2) < 0.03)


def floor(step_m: float = 0.2, offset_m: float = 0.0, length_m: float = 40.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, length_m, step_m) + offset_m, np.arange(-2, 2, step_m) + offset_m)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@pytest.mark.parametrize("height_m", [0.0, 0.05, -0.2])
def test_distance_to_a_plane_is_the_height_above_it_wherever_the_points_lie(height_m: float) -> None:
    inner = floor(offset_m=0.1)
    inner = inner[(inner[:, 0] > 1) & (inner[:, 0] < 39) & (np.abs(inner[:, 1]) < 1.5)]
    # half a cell aside, the nearest point is 14 cm away whatever the height
    distances = surface_distances(floor(), inner + np.array([0.0, 0.0, height_m]))
    np.testing.assert_allclose(distances, abs(height_m), atol=1e-12)


def test_far_points_are_as_far_as_the_nearest_point() -> None:
    points = np.array([[5.0, 0.0, 3.0], [-4.0, 0.0, 0.0], [5.0, 0.0, 0.31]])
    before = floor()
    brute = np.linalg.norm(points[:, None] - before[None], axis=2).min(axis=1)
    np.testing.assert_allclose(surface_distances(before, points), brute, atol=1e-12)


def test_distances_do_not_depend_on_where_the_maps_stand() -> None:
    draw = np.random.default_rng(0)
    before, after = draw.uniform(0, 2, (500, 3)), draw.uniform(0, 2, (200, 3))
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    moved = surface_distances(before @ turn.T + [300.0, 20.0, -7.0], after @ turn.T + [300.0, 20.0, -7.0])
    np.testing.assert_allclose(moved, surface_distances(before, after), atol=1e-9)


def test_worst_stretch_is_where_the_maps_bend_apart_and_not_where_one_session_never_was() -> None:
    points = floor()
    distances = np.full(len(points), 0.01)
    bent = (points[:, 0] >= 16) & (points[:, 0] < 24)
    distances[bent] = 0.1
    distances[points[:, 0] >= 32] = 5.0  # nothing before: new, or never seen
    place = worst_stretch(points, distances)
    assert place is not None
    assert 16 < place[0] < 24
    assert worst_stretch(points, np.full(len(points), 5.0)) is None


def test_a_few_strays_are_no_worst_stretch() -> None:
    points = np.concatenate([floor(), np.column_stack([np.full(9, 100.0), np.arange(9.0), np.zeros(9)])])
    distances = np.concatenate([np.full(len(floor()), 0.01), np.full(9, 0.9)])
    place = worst_stretch(points, distances)
    assert place is not None
    assert place[0] < 40


def test_the_picture_is_dark_where_the_maps_are_apart() -> None:
    before = floor()
    after = floor(offset_m=0.1)
    after[after[:, 0] > 30, 2] += 0.5
    bent = pixels(alignment_picture(before, after))
    flat = pixels(alignment_picture(before, floor(offset_m=0.1)))
    above = slice(0, int(bent.shape[0] * 0.75))  # without the scale
    darkest = "#6d0f00"
    assert len(near(bent[above], darkest)) > 200
    assert len(near(flat[above], darkest)) == 0
    # the end of the drift, in the left panel, is right of its middle
    left_panel = near(bent[above, : int(bent.shape[1] * 0.66)], darkest)
    assert left_panel[:, 1].mean() > 0.33 * bent.shape[1]


def test_the_window_holds_both_maps_and_the_whole_square() -> None:
    assert _around_both((0.0, 40.0, -2.0, 2.0), (30.0, 46.0, -8.0, 8.0)) == (0.0, 46.5, -8.5, 8.5)
    inside = (0.0, 100.0, -50.0, 50.0)
    assert _around_both(inside, (30.0, 46.0, -8.0, 8.0)) == inside


def test_the_whole_outline_of_the_worst_square_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    figures: list[Figure] = []
    monkeypatch.setattr(merge_figures, "data_address", lambda figure: figures.append(figure) or "")
    after = floor(offset_m=0.1)
    after[after[:, 0] > 32, 2] += 0.1
    merge_figures.alignment_picture(floor(), after)
    whole = figures[0].axes[0]
    (square,) = whole.patches
    (left, right), (bottom, top) = whole.get_xlim(), whole.get_ylim()
    x, y = square.get_xy()
    assert left < x < x + square.get_width() < right
    assert bottom < y < y + square.get_height() < top


def test_maps_that_never_meet_make_a_picture() -> None:
    assert pixels(alignment_picture(floor(), floor() + np.array([500.0, 0.0, 0.0]))).ndim == 3
