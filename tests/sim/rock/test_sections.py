from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from scenarios.schema import Section
from sim.rock.sections import cave_floor_m, profile_distance

SHAPES = get_args(Section.model_fields["shape"].annotation)
SIZES = ((5.0, 4.0), (10.0, 5.0), (3.0, 5.0))  # usual, flat, tall


def section(shape: str, width_m: float = 5.0, height_m: float = 4.0) -> Section:
    return Section.model_validate({"shape": shape, "width_m": width_m, "height_m": height_m})


def section_distance(which: Section, side_m: Float64Array, up_m: Float64Array) -> Float64Array:
    return profile_distance(which.shape, which.width_m / 2, which.height_m, side_m, up_m)


def distance(which: Section, *points: tuple[float, float]) -> Float64Array:
    return section_distance(which, *np.array(points).T)


def test_d_by_hand() -> None:
    # upright to 1.5 m, then a half circle of 2.5 m about (0, 1.5)
    on_it = distance(section("d"), (0.0, 4.0), (2.5, 0.7), (-2.5, 0.0), (1.5, 3.5), (-2.0, 3.0))
    np.testing.assert_allclose(on_it, 0.0, atol=1e-12)
    np.testing.assert_allclose(distance(section("d"), (0.0, 5.0), (1.0, 1.0), (0.0, 2.5)), [1.0, -1.5, -1.5])
    # 2 m high, 10 m wide: walls of 0.7 m, a half ellipse of 5 by 1.3 m above
    flat = section("d", 10.0, 2.0)
    np.testing.assert_allclose(
        distance(flat, (5.0, 0.5), (0.0, 2.0), (3.0, 0.7 + 1.3 * 0.8), (-4.0, 0.7 + 1.3 * 0.6)), 0.0, atol=1e-12
    )


def test_horseshoe_by_hand() -> None:
    # As d above 1.5 m. Below, an arc of 5 m about (-2.5, 1.5): at the floor x = sqrt(25 - 2.25) - 2.5.
    foot_m = np.sqrt(22.75) - 2.5
    on_it = distance(section("horseshoe"), (0.0, 4.0), (1.5, 3.5), (2.5, 1.5), (foot_m, 0.0), (-foot_m, 0.0))
    np.testing.assert_allclose(on_it, 0.0, atol=1e-12)
    assert 2.25 < foot_m < 2.5
    # A tall one leans in by about a tenth of its width, not more.
    tall = section("horseshoe", 3.0, 5.0)
    inner, outer = distance(tall, (1.5 - 0.33, 0.0), (1.5 - 0.27, 0.0))
    assert inner < 0 < outer


def test_arch_and_rectangle_by_hand() -> None:
    # rise 1 m over 5 m: radius (2.5^2 + 1) / 2 = 3.625 m about (0, 0.375)
    on_it = distance(section("arch"), (0.0, 4.0), (2.5, 3.0), (2.5, 0.0), (-1.5, 0.375 + np.sqrt(3.625**2 - 1.5**2)))
    np.testing.assert_allclose(on_it, 0.0, atol=1e-12)
    np.testing.assert_allclose(distance(section("arch"), (2.0, 1.0), (0.0, 3.5)), [-0.5, -0.5])
    np.testing.assert_allclose(distance(section("rectangle"), (-1.5, 1.0), (0.0, 4.5), (3.0, 1.0)), [-1.0, 0.5, 0.5])


def test_a_cave_has_no_corner_between_floor_and_wall() -> None:
    cave = section("cave")
    # Widest at 0.42 of the height, flat in the middle of the floor, and (3/4)^3 + (1 - up/1.68)^3 = 1 on the bowl.
    up_m = 1.68 * (1 - (1 - 0.75**3) ** (1 / 3))
    assert cave_floor_m(cave, 0.75 * 2.5) == pytest.approx(up_m)
    on_it = distance(
        cave, (2.5, 1.68), (-2.5, 1.68), (0.0, 0.0), (0.0, 4.0), (0.75 * 2.5, up_m), (2.0, 1.68 + 0.6 * 2.32)
    )
    np.testing.assert_allclose(on_it, 0.0, atol=1e-12)
    assert cave_floor_m(cave, 0.5 * 2.5) < 0.1
    # The outline turns by less than 12 degrees within any 10 cm.
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    outline = crossings(cave, angle)
    along_m = np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))
    heading = np.unwrap(np.arctan2(*np.diff(outline, axis=0).T[::-1]))
    even = np.arange(0.0, along_m[-1], 0.1)
    assert np.rad2deg(np.abs(np.diff(np.interp(even, along_m, heading))).max()) < 12


def crossings(which: Section, angle: Float64Array) -> Float64Array:
    """Where rays from 40 % of the height meet the outline, by bisection."""
    start, way = np.array([0.0, 0.4 * which.height_m]), np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = np.zeros(len(angle)), np.full(len(angle), which.width_m + which.height_m)
    for _ in range(50):
        middle = (low + high) / 2
        is_inside = section_distance(which, *(start + middle[:, None] * way).T) < 0
        low, high = np.where(is_inside, middle, low), np.where(is_inside, high, middle)
    return np.asarray(start + low[:, None] * way)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", SIZES)
def test_every_section_has_its_size_and_a_field_that_is_a_distance_near_the_outline(
    shape: str, size: tuple[float, float]
) -> None:
    which = section(shape, *size)
    width_m, height_m = size
    side = np.linspace(-0.75 * width_m, 0.75 * width_m, 601)[:, None]
    up = np.linspace(0.001, 1.3 * height_m, 501)[None, :]
    field = section_distance(which, side, up)
    inside = field < 0
    columns, rows = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    assert 2 * side[columns[-1], 0] == pytest.approx(width_m, abs=0.02 * width_m)
    assert up[0, rows[-1]] == pytest.approx(height_m, abs=0.01 * height_m)
    np.testing.assert_allclose(field, field[::-1], atol=1e-9)
    # One connected void without holes in a column, and no jump: neighbours differ by at most their distance, or nearly.
    assert (np.abs(np.diff(inside.astype(int), axis=1)).sum(axis=1) <= 2).all()
    step_m = side[1, 0] - side[0, 0], up[0, 1] - up[0, 0]
    near = np.abs(field) < 0.3
    for axis in (0, 1):
        slope = np.abs(np.diff(field, axis=axis)) / step_m[axis]
        both = near[1:] & near[:-1] if axis == 0 else near[:, 1:] & near[:, :-1]
        assert slope[both].max() < 1.35


def test_local_sizes_are_the_section_of_that_size() -> None:
    rng = np.random.default_rng(0)
    side, up = rng.uniform(-3, 3, 40), rng.uniform(0, 5, 40)
    width, height = rng.uniform(3, 6, 40), rng.uniform(2.5, 5, 40)
    for shape in SHAPES:
        together = profile_distance(shape, width / 2, height, side, up)
        one_by_one = [
            distance(section(shape, float(w), float(h)), (s, u))[0]
            for w, h, s, u in zip(width, height, side, up, strict=True)
        ]
        np.testing.assert_allclose(together, one_by_one, atol=1e-12)
