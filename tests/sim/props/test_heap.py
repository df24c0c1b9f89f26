"""Muck piles: closed, at the angle of repose, of the volume stated, and what a loader leaves of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from scenarios.schema import Prop
from sim.geometry.mesh import Mesh, join_meshes
from sim.geometry.raycast import Caster
from sim.geometry.topology import edges_of
from sim.props.bed import bed_mesh
from sim.props.heap import Heap, build_heap, column_volume_m3, flank_angle_deg, load_away, whole_mesh
from sim.props.parts import block, revolve, surface
from sim.props.props import shape_of
from sim.props.shapes import BELOW_FLOOR_M, Shape, Size, signed_volume_m3, solid_mesh, visible_part

OPEN = ((6.0, 4.5, 1.3), 37.0, 0.25, False)
BANKED = ((5.0, 2.5, 1.4), 35.0, 0.3, True)
SMALL = ((1.6, 1.2, 0.35), 40.0, 0.15, False)
CASES = [OPEN, BANKED, SMALL]
Case = tuple[Size, float, float, bool]


@cache
def heap_of(case: Case, seed: int = 1, name: str = "pile") -> Heap:
    size_m, repose_deg, fragment_m, is_banked = case
    return build_heap(size_m, repose_deg, fragment_m, is_banked, seed, name)


def shape_from(mesh: Mesh, size_m: Size) -> Shape:
    return Shape((surface(mesh, "rock"),), size_m, False, 0.0)


def cone(angle_deg: float) -> tuple[Mesh, Size]:
    rise = 2.0 * float(np.tan(np.deg2rad(angle_deg)))
    below = 1.0 + 0.3 / rise * 1.0
    profile = [(0.0, -0.6), (below, -0.6), (below, -0.3), (0.0, rise)]
    return revolve(profile, 4.0, 4.0, segments=240), (4.0, 4.0, rise)


def test_the_flank_of_a_cone() -> None:
    for angle_deg in (34.0, 40.0):
        mesh, size_m = cone(angle_deg)
        assert flank_angle_deg(shape_from(mesh, size_m)) == pytest.approx(angle_deg, abs=0.5)


def test_column_volume_of_a_cone_and_of_a_box() -> None:
    mesh, size_m = cone(37.0)
    assert column_volume_m3(mesh, size_m) == pytest.approx(np.pi * 4.0 * size_m[2] / 3, rel=2e-3)
    brick = solid_mesh(block((-0.5, -0.4, -0.6), (0.5, 0.4, 0.3), "rock"))
    assert column_volume_m3(brick, (1.0, 0.8, 0.3)) == pytest.approx(0.24, rel=1e-5)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_flanks_lie_at_the_angle_of_repose(case: Case, seed: int) -> None:
    heap = heap_of(case, seed)
    assert flank_angle_deg(shape_from(whole_mesh(heap), heap.size_m)) == pytest.approx(case[1], abs=2.0)


@pytest.mark.parametrize("case", CASES)
def test_a_pile_is_closed_faces_outwards_and_goes_below_the_floor(case: Case) -> None:
    heap = heap_of(case)
    for part in (bed_mesh(heap.bed), *heap.rubble.fragments):
        assert edges_of(part).is_closed
        assert signed_volume_m3(part) > 0
    assert bed_mesh(heap.bed).vertices[:, 2].min() < -BELOW_FLOOR_M
    assert len(whole_mesh(heap).faces) < 31_000


@pytest.mark.parametrize("case", CASES)
def test_a_pile_fills_its_bounding_box(case: Case) -> None:
    heap = heap_of(case)
    length, width, height = heap.size_m
    seen = visible_part(whole_mesh(heap), width / 2 if heap.is_banked else np.inf).reshape(-1, 3)
    np.testing.assert_allclose(seen.min(axis=0), [-length / 2, -width / 2, 0.0], atol=1e-9)
    np.testing.assert_allclose(seen.max(axis=0), [length / 2, width / 2, height], atol=1e-9)
    # Not larger than asked for, and a few centimetres smaller at most.
    wanted = np.array(case[0])
    assert (np.array(heap.size_m) <= wanted + 1e-9).all()
    assert (np.array(heap.size_m) > wanted - 0.05).all()


def test_a_height_that_the_flanks_do_not_reach_is_lowered() -> None:
    heap = heap_of(((4.0, 3.0, 3.0), 37.0, 0.25, False))
    apex_m = 1.5 * np.tan(np.deg2rad(37.0))
    assert 0.75 * apex_m < heap.size_m[2] < 1.15 * apex_m
    assert flank_angle_deg(shape_from(whole_mesh(heap), heap.size_m)) == pytest.approx(37.0, abs=2.0)


def heights(mesh: Mesh, xy: np.ndarray) -> np.ndarray:
    origins = np.column_stack([xy, np.full(len(xy), 9.0)])
    ranges_m, _, _ = Caster([mesh]).cast(origins, np.tile([0.0, 0.0, -1.0], (len(xy), 1)))
    return 9.0 - ranges_m.astype(np.float64)


def test_a_banked_pile_is_highest_at_the_wall_and_goes_on_behind_it() -> None:
    heap = heap_of(BANKED)
    half = heap.size_m[1] / 2
    ridge = heights(bed_mesh(heap.bed), np.column_stack([np.zeros(4), [-0.5 * half, 0.0, 0.5 * half, half]]))
    assert (np.diff(ridge) > 0).all() or ridge[-1] > 0.9 * heap.size_m[2]
    behind = heights(bed_mesh(heap.bed), np.array([[0.0, half + 0.5]]))
    assert behind[0] == pytest.approx(ridge[-1], abs=0.15)
    shape = shape_of(
        Prop(name="pile", kind="muck_pile", size_m=BANKED[0], repose_deg=35.0, fragment_m=0.3), 1, is_banked=True
    )
    assert shape.size_m == heap.size_m
    # Nothing behind the plane counts: the hull fits in the bounding box, the volume in the hull.
    assert shape.mesh_volume_m3 is not None
    assert shape.mesh_volume_m3 < shape.hull_volume_m3 < np.prod(heap.size_m)


@pytest.mark.parametrize("case", [OPEN, SMALL])
def test_fragments_have_the_sizes_of_the_law_and_cover_the_pile(case: Case) -> None:
    heap = heap_of(case)
    sizes = np.array(
        [2 * np.linalg.norm(f.vertices - f.vertices.mean(axis=0), axis=1).max() for f in heap.rubble.fragments]
    )
    assert 100 < len(sizes) <= 915
    largest_m = min(1.6 * case[2], case[0][2] / 3)
    assert np.quantile(sizes, 0.99) < 2.0 * largest_m
    seen = np.random.default_rng(0).uniform(-0.35, 0.35, (4000, 2)) * case[0][:2]
    owner = Caster([bed_mesh(heap.bed), join_meshes(list(heap.rubble.fragments))])
    _, part, _ = owner.cast(np.column_stack([seen, np.full(4000, 9.0)]), np.tile([0.0, 0.0, -1.0], (4000, 1)))
    assert 0.4 < (part == 1).mean() < 0.9


@pytest.mark.parametrize(("case", "share"), [(OPEN, 0.4), (BANKED, 0.6), (SMALL, 0.3)])
def test_a_loader_takes_its_share_and_leaves_the_rest_as_it_was(case: Case, share: float) -> None:
    whole = heap_of(case)
    left = load_away(whole, share, case[2], 1, "pile")
    volumes = [column_volume_m3(whole_mesh(heap), whole.size_m) for heap in (whole, left)]
    assert volumes[1] / volumes[0] == pytest.approx(1.0 - share, abs=0.02)
    is_cut = left.bed.z < whole.bed.z
    np.testing.assert_array_equal(left.bed.z[~is_cut], whole.bed.z[~is_cut])
    np.testing.assert_array_equal(left.bed.is_cell, whole.bed.is_cell)
    assert 0.1 < is_cut[whole.bed.z > 0].mean() < 0.95
    # Old fragments are the very same triangles; those that are gone stood in the bite.
    old = {fragment.vertices.tobytes() for fragment in whole.rubble.fragments}
    kept = {fragment.vertices.tobytes() for fragment in left.rubble.fragments} & old
    assert kept
    floating_m = left.rubble.centres[:, 2] - left.bed.heights(left.rubble.centres[:, :2])
    assert floating_m[whole.bed.heights(left.rubble.centres[:, :2]) > 0].max() < 0.25
    for fragment, centre in zip(whole.rubble.fragments, whole.rubble.centres, strict=True):
        if fragment.vertices.tobytes() not in kept:
            nodes = np.abs(left.bed.x - centre[0]).argmin(), np.abs(left.bed.y - centre[1]).argmin()
            near = is_cut[max(nodes[0] - 2, 0) : nodes[0] + 3, max(nodes[1] - 2, 0) : nodes[1] + 3]
            assert near.any()
    assert edges_of(bed_mesh(left.bed)).is_closed


@pytest.mark.parametrize("case", [OPEN, BANKED])
def test_a_fresh_face_is_steeper_than_the_flanks(case: Case) -> None:
    whole = heap_of(case)
    left = load_away(whole, 0.5, case[2], 1, "pile")
    is_face = (left.bed.z < whole.bed.z) & (left.bed.z > 0.02)
    is_inside = (
        is_face & np.roll(is_face, 1, 0) & np.roll(is_face, -1, 0) & np.roll(is_face, 1, 1) & np.roll(is_face, -1, 1)
    )
    slope = np.gradient(left.bed.z, left.bed.x, left.bed.y)
    angle = np.rad2deg(np.arctan(np.hypot(*slope)))[is_inside]
    assert len(angle) > 5
    assert angle.min() > 44.0
    assert angle.max() < 62.0


def test_shapes_of_a_reshaped_pile_give_the_volume_that_is_gone() -> None:
    prop = Prop(
        name="p", kind="muck_pile", size_m=(2.0, 1.5, 0.5), change="reshaped", loaded_share=0.45, repose_deg=36.0
    )
    whole, left = shape_of(prop, 3), shape_of(prop, 3, loaded_share=0.45)
    assert whole.mesh_volume_m3 is not None
    assert left.mesh_volume_m3 is not None
    assert left.mesh_volume_m3 / whole.mesh_volume_m3 == pytest.approx(0.55, abs=0.02)
    assert left.size_m[:2] == whole.size_m[:2]
    assert left.size_m[2] == solid_mesh(left.solids[0]).vertices[:, 2].max()
    assert left.hull_volume_m3 < whole.hull_volume_m3
    again = shape_of(prop, 3, loaded_share=0.45)
    np.testing.assert_array_equal(solid_mesh(again.solids[0]).vertices, solid_mesh(left.solids[0]).vertices)


@pytest.mark.parametrize("size_m", [(1.6, 1.2, 0.14), (0.5, 0.4, 0.05)])
def test_a_pile_too_low_for_fragments_of_5_cm_is_built_of_finer_ones(
    size_m: tuple[float, float, float], make_prop: Callable[..., Prop]
) -> None:
    shape = shape_of(make_prop("low", kind="muck_pile", size_m=size_m), 0)
    assert shape.mesh_volume_m3 is not None
    assert 0 < shape.mesh_volume_m3 < size_m[0] * size_m[1] * size_m[2]
    less = make_prop("low", kind="muck_pile", size_m=size_m, change="reshaped", loaded_share=0.4)
    assert (shape_of(less, 0, loaded_share=0.4).mesh_volume_m3 or 0) < shape.mesh_volume_m3
