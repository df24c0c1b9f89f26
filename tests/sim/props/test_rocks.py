"""Fragments: closed, angular, of the size asked for; sizes by Rosin and Rammler."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.stats import kstest

from cdpipe.core.geometry import stream
from sim.geometry.mesh import join_meshes
from sim.geometry.topology import edges_of
from sim.props.rocks import (
    Rubble,
    confine,
    draw_sizes,
    join_rubble,
    lay_fragments,
    passing_share,
    rock_mesh,
    rosin_rammler,
    shift_rubble,
)
from sim.props.shapes import signed_volume_m3


def test_sizes_follow_the_law() -> None:
    sizes = rosin_rammler(4000, 0.25, stream(1, "sizes"))
    assert kstest(sizes, lambda size: 1 - np.exp(-((1.87 * size / 0.25) ** 0.88))).pvalue > 0.05
    assert (sizes > 0).all()


def test_passing_share_at_the_characteristic_size() -> None:
    # exp(-1.87^0.88) = exp(-1.7346) = 0.1765
    assert passing_share(np.array([0.25]), 0.25)[0] == pytest.approx(0.8235, abs=1e-4)


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
@pytest.mark.parametrize("key", [0, 5, 11])
def test_a_fragment_is_closed_faces_outwards_and_fills_its_box(key: int, subdivisions: int) -> None:
    mesh = rock_mesh((1.0, 0.8, 0.6), key, subdivisions)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.5, 0.4, 0.3], atol=1e-12)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.5, -0.4, -0.3], atol=1e-12)
    assert edges_of(mesh).is_closed
    hull_m3 = ConvexHull(mesh.vertices).volume
    # The volume of the convex hull comes from another program; chips take a little from it, never more than a fifth.
    share = signed_volume_m3(mesh) / hull_m3
    assert share == pytest.approx(1.0, abs=1e-9) if subdivisions == 0 else 0.8 < share < 1.0
    assert 0.3 * 0.48 < hull_m3 < 0.65 * 0.48


def test_each_subdivision_takes_four_times_as_many_triangles_and_keys_differ() -> None:
    counts = [len(rock_mesh((1, 1, 1), 3, n).faces) for n in range(3)]
    assert counts[1] == 4 * counts[0]
    assert counts[2] == 16 * counts[0] <= 16 * 22
    same, other = rock_mesh((1, 1, 1), 3), rock_mesh((1, 1, 1), 4)
    np.testing.assert_array_equal(rock_mesh((1, 1, 1), 3).vertices, same.vertices)
    assert same.vertices.shape != other.vertices.shape or np.abs(same.vertices - other.vertices).max() > 0.05


def laid_rubble(n: int) -> Rubble:
    generator = stream(n, "rubble")
    sizes, places = generator.uniform(0.1, 0.5, n), generator.uniform(-2.0, 2.0, (n, 2))
    return lay_fragments(sizes, places, lambda xy: np.asarray(0.1 * xy[:, 0]), (-0.2, 0.1), generator)


def test_rubble_is_moved_confined_and_joined_fragment_by_fragment() -> None:
    rubble, other = laid_rubble(40), laid_rubble(3)
    is_kept = np.arange(40) % 3 == 1
    kept = rubble.kept(is_kept)
    assert [each.vertices.tobytes() for each in kept.fragments] == [
        each.vertices.tobytes() for each, keep in zip(rubble.fragments, is_kept, strict=True) if keep
    ]
    shifts_m = np.random.default_rng(0).normal(size=(40, 3))
    for fragment, by_m, moved in zip(rubble.fragments, shifts_m, shift_rubble(rubble, shifts_m).fragments, strict=True):
        np.testing.assert_array_equal(moved.vertices, fragment.vertices + by_m)
        np.testing.assert_array_equal(moved.faces, fragment.faces)
    low, high = np.array([-1.0, -1.5, -np.inf]), np.array([1.0, 1.5, 0.2])
    assert any(each.vertices[:, 0].max() > 1.0 for each in rubble.fragments)
    for before, after in zip(rubble.fragments, confine(rubble, low, high).fragments, strict=True):
        assert (after.vertices.min(axis=0) >= low - 1e-12).all()
        assert (after.vertices.max(axis=0) <= high + 1e-12).all()
        np.testing.assert_allclose(np.ptp(after.vertices, axis=0), np.ptp(before.vertices, axis=0), atol=1e-12)
    joined = join_rubble(kept, other)
    whole, expected = joined.surface(), join_meshes([*kept.fragments, *other.fragments])
    np.testing.assert_array_equal(whole.vertices, expected.vertices)
    np.testing.assert_array_equal(whole.faces, expected.faces)
    assert len(joined) == len(joined.fragments) == is_kept.sum() + 3


def test_no_rubble_is_no_surface() -> None:
    none = laid_rubble(4).kept(np.zeros(4, bool))
    assert (len(none), none.fragments, len(none.surface().faces)) == (0, (), 0)
    assert len(confine(shift_rubble(none, np.ones(3)), np.zeros(3), np.ones(3))) == 0


def test_sizes_are_drawn_in_rounds_of_256_and_a_flat_pile_has_its_share_of_them() -> None:
    # by hand: what `draw_sizes` gives of a pile that is covered after a few rounds
    drawn = np.concatenate([rosin_rammler(256, 0.25, generator) for generator in [stream(3, "a")] for _ in range(9)])
    drawn = drawn[(drawn >= 0.05) & (drawn <= 0.4)]
    covered_m2 = 0.5 * np.cumsum(drawn**2)
    plan_m2 = float(covered_m2[700]) - 1e-6
    found = draw_sizes(plan_m2, 1.0, 0.25, 0.4, 900, stream(3, "a"))
    np.testing.assert_array_equal(found, np.sort(drawn[:701])[::-1])
    # 30 x 20 m of fragments of 1 to 2 mm would be 600 million
    flat = draw_sizes(600.0, 1.5, 0.25, 0.002, 900, stream(3, "b"))
    assert len(flat) == 900
    assert (np.diff(flat) <= 0).all() and flat.min() >= 0.001 and flat.max() <= 0.002
