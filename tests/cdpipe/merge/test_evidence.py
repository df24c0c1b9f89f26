from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, yaw_pose
from cdpipe.mapping.free_space import render_view
from cdpipe.merge.evidence import SurfaceFit, explain_refusal, measure_fit, sample_evenly
from cdpipe.merge.registration import IndexedMap
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import Float16Array, KeyframeViews, MappedSession

CONFIG = MergeConfig()
GOOD = {"overlap": 0.5, "inlier_share": 0.95, "hessian_ratio": 0.1, "agreement": 0.95, "distinctness": 10.0}


def floor(half_m: float = 12.0, step_m: float = 0.25) -> Float64Array:
    axis = np.arange(-half_m, half_m + 1e-9, step_m)
    return np.stack(np.meshgrid(axis, axis, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture
def floors(tunnel_before: MappedSession) -> tuple[IndexedMap, IndexedMap]:
    """A flat floor, mapped twice; the second map has points half way between those of the first."""
    points, near = floor(), np.ones(len(floor()), np.float32)
    maps = [
        replace(tunnel_before.map, points=points + np.array([shift, shift, 0.0]), nearest_m=near, seen_from=None)
        for shift in (0.0, 0.125)
    ]
    return IndexedMap(maps[0], CONFIG, is_target=True), IndexedMap(maps[1], CONFIG, is_target=False)


def fit_at(maps: tuple[IndexedMap, IndexedMap], pose: Float64Array) -> SurfaceFit:
    return measure_fit(*maps, pose, sample_evenly(maps[1].sphere(np.zeros(3), 5.0)), np.zeros(3), 5.0)


@pytest.mark.parametrize(("lift_m", "share"), [(0.0, 1.0), (0.09, 1.0), (0.11, 0.0)])
def test_a_lifted_floor_fits_up_to_the_inlier_distance(
    floors: tuple[IndexedMap, IndexedMap], lift_m: float, share: float
) -> None:
    fit = fit_at(floors, make_pose(translation=(0, 0, lift_m)))
    assert fit.inlier_share(0.1) == share
    assert fit.residual_m == pytest.approx(lift_m, abs=1e-9)


def test_what_does_not_fit_holds_nothing(tunnel_before: MappedSession) -> None:
    """A wall across the axis, which lies elsewhere in the other session."""
    across, up = (grid.ravel() for grid in np.meshgrid(np.arange(-3, 3, 0.1), np.arange(0.3, 3, 0.1)))
    maps = []
    for along_m in (3.0, 3.0, 3.3):
        points = np.concatenate([floor(), np.column_stack([np.full(len(up), along_m), across, up])])
        maps.append(
            replace(tunnel_before.map, points=points, nearest_m=np.ones(len(points), np.float32), seen_from=None)
        )
    target = IndexedMap(maps[0], CONFIG, is_target=True)
    held, moved = (fit_at((target, IndexedMap(each, CONFIG, is_target=False)), np.eye(4)) for each in maps[1:])
    assert held.information[3, 3] > 20
    assert moved.information[3, 3] < 0.05 * held.information[3, 3]


def test_distances_are_along_the_normal_and_not_to_the_next_point(floors: tuple[IndexedMap, IndexedMap]) -> None:
    # points of the second map lie a decimetre and more from the nearest of the first, but on its surface
    fit = fit_at(floors, make_pose(translation=(0.1, -0.05, 0.0)))
    assert fit.residual_m == pytest.approx(0.0, abs=1e-9)


def test_what_has_no_counterpart_does_not_fit(floors: tuple[IndexedMap, IndexedMap]) -> None:
    fit = fit_at(floors, make_pose(translation=(0, 0, 0.6)))
    assert np.isinf(fit.forward_m).all()
    assert fit.inlier_share(10.0) == 0.0
    # where the other map has nothing at all, there is no point of it to look at either
    assert fit_at(floors, make_pose(translation=(300.0, 0, 0))).inlier_share(0.1) == 0.0


def test_what_mist_hid_from_the_other_session_counts_for_nothing(floors: tuple[IndexedMap, IndexedMap]) -> None:
    before, after = floors
    # the first session met mist on one side: there it has no floor within 0.5 m of that of the second
    is_hidden = before.map.points[:, 0] > 2.0
    half = replace(before.map, points=before.map.points[~is_hidden], nearest_m=before.map.nearest_m[~is_hidden])
    sensor = make_pose(translation=(0.0, 0.0, 1.0))
    dense = floor(6.0, 0.02)
    met = transform(invert(sensor), dense[dense[:, 0] > 2.0])
    clear = render_view(transform(invert(sensor), half.points))
    misty = render_view(transform(invert(sensor), half.points), 0.3 * met)

    def share(view: Float16Array | None, lift_m: float = 0.0) -> float:
        views = None if view is None else KeyframeViews(view[None], invert(sensor)[None])
        maps = (IndexedMap(replace(half, views=views), CONFIG, is_target=True), after)
        return fit_at(maps, make_pose(translation=(0, 0, lift_m))).inlier_share(0.1)

    assert 0.6 < share(None) < 0.9
    assert share(clear) == share(None)
    assert share(misty) == pytest.approx(1.0)
    # what the session did see is no better for it, nor is an alignment that leaves most points without a counterpart
    assert share(misty, 0.2) == 0.0
    assert share(misty, 0.6) == share(clear, 0.6) == 0.0


def test_the_lower_of_both_directions_counts() -> None:
    fit = SurfaceFit(np.array([0.0, 0.0, 0.3, 0.3]), np.array([0.0, 0.3, 0.3, np.inf]), np.eye(6))
    assert fit.inlier_share(0.1) == 0.25


def test_a_plane_holds_one_direction_only_whichever_way_the_maps_are_turned(
    floors: tuple[IndexedMap, IndexedMap],
) -> None:
    for pose in (make_pose(), yaw_pose(1.0)):
        eigenvalues = np.linalg.eigvalsh(fit_at(floors, pose).information[3:, 3:])
        assert eigenvalues[:2] == pytest.approx(0.0, abs=1e-6)
        assert eigenvalues[2] > 100


def test_samples_are_every_kth_point() -> None:
    points = np.arange(3000.0).reshape(1000, 3)
    np.testing.assert_array_equal(sample_evenly(points, 300), points[::3])
    np.testing.assert_array_equal(sample_evenly(points[:10], 300), points[:10])


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("overlap", 0.1, "only 10% of the shorter one"),
        ("inlier_share", 0.5, "only 50% of the points around the best pair"),
        ("hessian_ratio", 0.0051, "degenerate"),
        ("agreement", 0.7, "two places that look alike"),
        ("distinctness", 1.1, "the tunnel repeats itself"),
    ],
)
def test_each_gate_refuses_alone_and_says_why(name: str, value: float, said: str) -> None:
    assert explain_refusal(GOOD, CONFIG) == ""
    reason = explain_refusal({**GOOD, name: value}, CONFIG)
    assert said in reason
    assert f"merge.min_{name} asks for" in reason


def test_what_could_not_be_measured_is_refused_without_a_number() -> None:
    for name in GOOD:
        without = {key: value for key, value in GOOD.items() if key != name}
        for evidence in ({**GOOD, name: float("nan")}, without):
            reason = explain_refusal(evidence, CONFIG)
            assert "nan" not in reason and "record a path" in reason and f"merge.min_{name} " in reason


@pytest.mark.parametrize("name", ["overlap", "inlier_share", "hessian_ratio", "agreement"])
def test_of_one_place_each_gate_says_what_to_record(name: str) -> None:
    place = {**GOOD, "both_ways_m": 0.05, "both_ways_deg": 0.5}
    assert explain_refusal(place, CONFIG) == ""
    reason = explain_refusal({**place, name: 0.001}, CONFIG)
    assert "record a path of ten metres or more" in reason and f"merge.min_{name} asks for" in reason


@pytest.mark.parametrize("wrong", [{"both_ways_m": 0.06}, {"both_ways_deg": 0.6}])
def test_registrations_of_one_place_that_differ_are_refused(wrong: dict[str, float]) -> None:
    reason = explain_refusal({**GOOD, "both_ways_m": 0.0, "both_ways_deg": 0.0, **wrong}, CONFIG)
    assert "(both_ways)" in reason and "record a path of ten metres or more" in reason


def test_the_gate_itself_is_enough() -> None:
    at_the_gate = {name: getattr(CONFIG, f"min_{name}") for name in GOOD}
    assert explain_refusal(at_the_gate, CONFIG) == ""
