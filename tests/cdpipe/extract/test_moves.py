from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, make_pose, stream, transform, yaw_pose
from cdpipe.extract.moves import Move, find_moves

STEP_M = 0.06


def face(low: tuple[float, float, float], high: tuple[float, float, float]) -> Float64Array:
    """An axis-aligned rectangle or block of points."""
    axes = [np.linspace(a, b, max(1, round((b - a) / STEP_M))) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def chair() -> Float64Array:
    """Seat, back and legs: 0.5 x 0.5 x 0.95 m."""
    legs = [face((x, y, 0), (x, y, 0.45)) for x in (0.0, 0.5) for y in (0.0, 0.5)]
    return np.concatenate([face((0, 0, 0.45), (0.5, 0.5, 0.45)), face((0, 0, 0.5), (0, 0.5, 0.95)), *legs])


def barrel(radius_m: float = 0.25, height_m: float = 0.95) -> Float64Array:
    angles = np.arange(0, 2 * np.pi, STEP_M / radius_m)
    heights = np.linspace(0, height_m, round(height_m / STEP_M))
    side = np.array([[radius_m * np.cos(a), radius_m * np.sin(a), z] for a in angles for z in heights])
    lid = face((-radius_m, -radius_m, height_m), (radius_m, radius_m, height_m))
    return np.concatenate([side, lid[np.linalg.norm(lid[:, :2], axis=1) < radius_m]])


def box(size: tuple[float, float, float], sides: str) -> Float64Array:
    """The top of a box and some of its sides: l, r at the ends of x, f, b at those of y."""
    x, y, z = size
    all_sides = {
        "l": face((0, 0, 0), (0, y, z)),
        "r": face((x, 0, 0), (x, y, z)),
        "f": face((0, 0, 0), (x, 0, z)),
        "b": face((0, y, 0), (x, y, z)),
    }
    return np.concatenate([face((0, 0, z), (x, y, z)), *(all_sides[side] for side in sides)])


def shifted(points: Float64Array, x: float, y: float = 0.0) -> Float64Array:
    return points + np.array([x, y, 0.0])


def noisy(points: Float64Array, purpose: str, noise_m: float = 0.01) -> Float64Array:
    noise: Float64Array = stream(5, "moves", purpose).normal(scale=noise_m, size=points.shape)
    return points + noise


def moves(removed: Sequence[Float64Array], added: Sequence[Float64Array]) -> list[Move]:
    """Moves where nothing but these objects was there."""
    nothing = np.zeros((0, 3))
    return find_moves(removed, added, lambda pairs: [(nothing, nothing)] * len(pairs))


def test_an_object_of_points_that_all_lie_apart_is_no_error() -> None:
    loose = 5.0 * face((0, 0, 0), (0.3, 0.3, 0))
    assert len(loose) > 20  # 0.3 m apart
    for other in (loose, box((0.8, 0.6, 0.5), "lf")):
        moves([loose], [shifted(other, 30)])


def test_what_was_turned_and_carried_off_is_one_object_and_where_it_went_is_told() -> None:
    size = (1.1, 0.7, 0.6)
    middle = np.array([[0.55, 0.35, 0.3]])
    whole, pose = box(size, "lrfb"), yaw_pose(1.2, (4.0, -3.0, 0.1))
    (move,) = moves([noisy(whole, "a")], [noisy(transform(pose, whole), "b")])
    assert (move.removed, move.added) == (0, 0)
    np.testing.assert_allclose(move.displacement_map, (transform(pose, middle) - middle)[0], atol=0.03)


def test_an_object_seen_from_two_sides_went_where_it_went() -> None:
    # the top and two sides before, the top and the other long side after: centres of points differ by decimetres
    size, pose = (1.1, 0.7, 0.6), yaw_pose(-0.5, (2.5, 1.0, 0.0))
    start, end = noisy(box(size, "lf"), "a"), noisy(transform(pose, box(size, "rb")), "b")
    middle = np.array([[0.55, 0.35, 0.3]])
    went = (transform(pose, middle) - middle)[0]
    assert np.linalg.norm(end.mean(axis=0) - start.mean(axis=0) - went) > 0.15
    (move,) = moves([start], [end])
    np.testing.assert_allclose(move.displacement_map, went, atol=0.05)


@pytest.mark.parametrize("tilt_deg", [90, 135])
def test_a_chair_that_lies_where_it_went_is_the_one_that_stood(tilt_deg: float) -> None:
    turn = Rotation.from_euler("xz", [tilt_deg, 70], degrees=True).as_matrix()
    pose, middle = make_pose(turn, np.array([5.0, 3.0, 0.4])), np.array([[0.25, 0.25, 0.475]])
    (move,) = moves([noisy(chair(), "a")], [noisy(transform(pose, chair()), "b")])
    # the displacement is that of the box around it, which is larger where it lies askew
    np.testing.assert_allclose(move.displacement_map, (transform(pose, middle) - middle)[0], atol=0.1)
    # what was cut out by whole map points is too sparse to be turned any way
    nothing = np.zeros((0, 3))
    ends = [noisy(chair(), "a")], [noisy(transform(pose, chair()), "b")]
    assert find_moves(*ends, lambda pairs: [(nothing, nothing)] * len(pairs), nearest_twins=False) == []


def test_a_lying_barrel_is_no_chair() -> None:
    pose = make_pose(Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.array([5.0, 3.0, 0.4]))
    assert moves([chair()], [transform(pose, barrel())]) == []
    assert len(moves([barrel()], [transform(pose, barrel())])) == 1


def test_a_few_returns_behind_an_edge_do_not_hide_where_an_object_went() -> None:
    # Eight returns 0.8 m behind it move the centre of the box around an object by 0.4 m, another way in either session.
    size, pose = (0.81, 0.64, 0.52), yaw_pose(1.45, (-3.3, 0.1, 0.0))
    whole, middle = box(size, "lf"), np.array([[0.4, 0.32, 0.26]])
    tail = face((0.1, 1.4, 0.3), (0.7, 1.4, 0.3))[:8]
    start = noisy(np.concatenate([whole, tail]), "a")
    end = noisy(np.concatenate([transform(pose, whole), transform(pose, middle) + shifted(tail, -0.4, 0.1)]), "b")
    (move,) = moves([start], [end])
    np.testing.assert_allclose(move.displacement_map, (transform(pose, middle) - middle)[0], atol=0.05)


def test_a_chair_is_not_a_barrel_of_the_same_extents() -> None:
    far = yaw_pose(0.7, (5.0, 2.0, 0.0))
    assert moves([chair()], [transform(far, barrel())]) == []
    # where both are, each finds its own, whatever the order and the distance
    further = yaw_pose(2.0, (12.0, 2.0, 0.0))
    added = [transform(far, barrel()), transform(further, chair())]
    found = moves([chair(), barrel()], added)
    assert [(move.removed, move.added) for move in found] == [(0, 1), (1, 0)]


@pytest.mark.parametrize("factor", [0.6, 1.7])
def test_the_same_shape_in_another_size_is_another_object(factor: float) -> None:
    crate = box((1.0, 0.7, 0.6), "lrfb")
    assert moves([crate], [shifted(crate * factor, 3.0)]) == []


@pytest.mark.parametrize(("length_m", "is_same"), [(1.25, True), (1.7, False)])
def test_a_longer_box_is_another_object_however_well_they_fit(length_m: float, is_same: bool) -> None:
    short, long = box((1.0, 0.6, 0.5), "lrfb"), box((length_m, 0.6, 0.5), "lrfb")
    assert len(moves([short], [shifted(long, 5.0)])) == is_same


def test_one_object_moves_once_and_of_two_alike_the_nearer_is_it() -> None:
    few = chair()
    copies = [shifted(few, 9.0), noisy(shifted(few, 4.0), "a", 0.004)]  # the farther one fits a little better
    for nearer, both in ((1, copies), (0, copies[::-1])):
        (move,) = moves([few], both)
        assert move.added == nearer
        np.testing.assert_allclose(move.displacement_map, [4, 0, 0], atol=0.03)
        (move,) = moves(both, [few])
        assert move.removed == nearer


def test_the_best_pairing_is_not_given_up_for_more_pairs() -> None:
    # the crate went to the crate; that leaves a removed box and an added one which are not alike enough
    crate, low = box((1.0, 0.7, 0.6), "lrfb"), box((1.05, 0.75, 0.45), "lrfb")
    barrel_there = transform(yaw_pose(0, (7.0, 0, 0)), barrel(0.42, 0.55))
    found = moves([crate, low], [barrel_there, shifted(crate, 4.0, 1.0)])
    assert (0, 1) in [(move.removed, move.added) for move in found]


def test_what_stuck_out_of_a_short_move_is_paired() -> None:
    # a box 0.9 m long pushed by 0.5 m along itself: of its top and front only what the other one does not cover, of its
    # ends both, for each stands clear of the other box or inside of it
    start, end = box((0.9, 0.6, 0.5), "lrf"), shifted(box((0.9, 0.6, 0.5), "lrf"), 0.5)
    start = start[(start[:, 0] < 0.45) | (start[:, 0] > 0.899)]
    end = end[(end[:, 0] > 0.95) | (end[:, 0] < 0.501)]
    (move,) = moves([start], [end])
    np.testing.assert_allclose(move.displacement_map, [0.5, 0, 0], atol=0.1)


def test_strips_that_are_not_alike_are_one_object_with_what_seems_to_have_stayed() -> None:
    # A tall box pushed by 0.3 m: what sticks out is a strip of its top and front before, a strip of its top and front
    # and its end after. The end it had before is inside of where it stands now: no ray tells that it has gone.
    start = noisy(box((1.2, 1.0, 1.5), "fr"), "a", 0.005)
    end = noisy(shifted(box((1.2, 1.0, 1.5), "fr"), 0.3), "b", 0.005)
    gone, come = start[start[:, 0] < 0.25], end[end[:, 0] > 1.25]
    (alone,) = moves([gone], [come])  # strip on strip
    assert alone.displacement_map[0] > 1.0
    (move,) = find_moves([gone], [come], lambda pairs: [(start, end)] * len(pairs))
    np.testing.assert_allclose(move.displacement_map, [0.3, 0.0, 0.0], atol=0.05)


def test_neighbours_that_share_just_enough_points_but_are_hardly_alike_are_two_objects() -> None:
    # both have a rail of a metre on the floor; the other metre stands in one and lies across in the other
    rail = face((0, 0, 0), (1.0, 0, 0))
    post = np.concatenate([rail, face((0, 0, 0), (0, 0, 1.0))])
    corner = np.concatenate([rail, face((0, 0, 0), (0, 1.0, 0))])
    assert moves([noisy(post, "a")], [noisy(shifted(corner, 0.3, 0.1), "b")]) == []
    assert len(moves([noisy(post, "a")], [noisy(shifted(post, 0.3, 0.1), "b")])) == 1


@pytest.mark.parametrize("gap_m", [0.3, 0.9, 1.4])
def test_a_tall_box_did_not_become_the_cube_beside_it(gap_m: float) -> None:
    tall, cube = box((0.6, 0.6, 1.0), "flr"), shifted(box((0.5, 0.5, 0.5), "flr"), 0.6 + gap_m)
    ground = face((-4, -4, 0), (8, 4, 0))
    objects = [noisy(tall, "tall")], [noisy(cube, "cube")]
    assert find_moves(*objects, lambda pairs: [(ground, ground)] * len(pairs)) == []
    assert len(moves([noisy(tall, "tall")], [noisy(shifted(tall, 0.6 + gap_m), "again")])) == 1


def test_of_two_alike_the_one_on_another_level_is_farther() -> None:
    above = barrel() + np.array([0.8, 0.0, 12.0])
    (move,) = moves([barrel()], [above, shifted(barrel(), 3.0)])
    np.testing.assert_allclose(move.displacement_map, [3.0, 0.0, 0.0], atol=0.05)


def test_what_lies_on_what_stands_around_is_not_what_was_put_beside_it() -> None:
    # a load off the flank of a heap would lie on the rest of it; the chair put there would not
    heap = face((0, 0, 0), (2.0, 3.0, 0)) @ np.array([[1, 0, 0.6], [0, 1, 0], [0, 0, 0]])
    is_load = heap[:, 1] < 1.5
    put = shifted(chair(), 2.2, 1.0)
    around = (heap, np.concatenate([heap[~is_load], put]))
    assert find_moves([heap[is_load]], [put], lambda pairs: [around] * len(pairs)) == []


def test_only_neighbours_are_asked_what_stands_around_them() -> None:
    crate = box((1.0, 0.7, 0.6), "lrfb")
    asked: list[tuple[int, int]] = []

    def around(pairs: Sequence[tuple[int, int]]) -> list[tuple[Float64Array, Float64Array]]:
        asked.extend(pairs)
        return [(np.zeros((0, 3)), np.zeros((0, 3)))] * len(pairs)

    find_moves([crate, shifted(crate, 30.0)], [shifted(crate, 2.0), shifted(crate, 9.0)], around)
    assert asked == [(0, 0)]


def test_turning_the_map_turns_the_displacement() -> None:
    crate = noisy(box((1.1, 0.7, 0.6), "lf"), "a")
    there = noisy(transform(yaw_pose(0.9, (3.0, 2.0, 0.0)), box((1.1, 0.7, 0.6), "rf")), "b")
    (move,) = moves([crate], [there])
    turn = yaw_pose(2.2, (100.0, -30.0, 4.0))
    (turned,) = moves([transform(turn, crate)], [transform(turn, there)])
    np.testing.assert_allclose(turned.displacement_map, turn[:3, :3] @ move.displacement_map, atol=0.02)


def test_among_very_many_the_right_one_is_tried() -> None:
    crate = box((1.0, 0.7, 0.6), "lrfb")
    longer = [box((1.0 + 0.02 * n, 0.7 - 0.02 * n, 0.6), "lrfb") for n in (5, 6, 7, 8, 9, 10) * 2]
    others = [shifted(each, 3.0, 1.0 * n) for n, each in enumerate(longer)]  # nearer, and not equal
    (move,) = moves([crate], [*others, shifted(crate, 8.0)])
    assert move.added == len(others)


def test_a_few_points_are_nobody() -> None:
    few = chair()[:3]
    assert moves([few], [shifted(few, 2.0)]) == []
    assert moves([few[:1]], [chair()]) == []
    assert moves([], [chair()]) == moves([chair()], []) == []


def seen(points: Float64Array, share: float, purpose: str) -> Float64Array:
    """Some of the points, with noise."""
    return noisy(points[stream(6, "seen", purpose).random(len(points)) < share], purpose, 0.005)


def at(points: Float64Array, x: float, y: float, turn_rad: float) -> Float64Array:
    return transform(yaw_pose(turn_rad, (x, y, 0.0)), points)


def linked(found: Sequence[Move]) -> set[tuple[int, int]]:
    return {(move.removed, move.added) for move in found}


def test_of_equal_objects_each_moved_to_where_one_is_nearest_however_many_points_it_has() -> None:
    # three barrels and a fourth went, each seen from afar before and from near after or the other way round
    shares, places = ((1.0, 0.35), (0.35, 1.0), (0.9, 0.4)), (0.0, 40.0, 80.0)
    removed = [seen(at(barrel(), x, 0, x), share, f"gone {x}") for x, (share, _) in zip(places, shares, strict=True)]
    added = [
        seen(at(barrel(), x + 3, 1, 1.0), share, f"come {x}") for x, (_, share) in zip(places, shares, strict=True)
    ]
    removed.append(seen(at(barrel(), 60.0, 0.0, 0.3), 1.0, "taken away"))
    added.append(seen(at(barrel(), 120.0, 0.0, 0.3), 1.0, "put there"))
    found = moves(removed, added)
    assert linked(found) == {(0, 0), (1, 1), (2, 2), (3, 3)}
    # points alone give the barrels of many points to one another
    nothing = np.zeros((0, 3))
    by_points = find_moves(removed, added, lambda pairs: [(nothing, nothing)] * len(pairs), nearest_twins=False)
    assert linked(by_points) != linked(found)
    # without the two that lie far apart, and with one of them
    assert linked(moves(removed[:3], added[:3])) == {(0, 0), (1, 1), (2, 2)}
    assert linked(moves(removed, added[:3])) == {(0, 0), (1, 1), (2, 2)}
    assert linked(moves(removed[:3], added)) == {(0, 0), (1, 1), (2, 2)}


def test_equal_objects_seen_in_part_are_twins() -> None:
    # a barrel and its upper half, as a session sees it over something in front of it
    upper = barrel()[barrel()[:, 2] > 0.3]
    removed = [seen(at(each, x, 0, x), 0.9, f"gone {x}") for each, x in ((barrel(), 0.0), (upper, 40.0))]
    added = [seen(at(each, x, 1, 1.0), 0.9, f"come {x}") for each, x in ((upper, 3.0), (barrel(), 43.0))]
    assert linked(moves(removed, added)) == {(0, 0), (1, 1)}


def test_the_whole_of_the_ways_counts_not_the_way_of_the_first() -> None:
    # the removed crate at 0 is nearest to the added one at 4, which is the only one near the crate at 6
    crate = box((1.0, 0.7, 0.6), "lrfb")
    removed, added = [crate, shifted(crate, 8.0)], [shifted(crate, 4.5), shifted(crate, -5.0)]
    assert linked(moves(removed, added)) == {(0, 1), (1, 0)}


def test_the_nearest_of_very_many_equal_ones_is_tried() -> None:
    crate = box((1.0, 0.7, 0.6), "lrfb")
    removed = [seen(shifted(crate, 10.0 * n), 0.8, f"gone {n}") for n in range(9)]
    added = [seen(shifted(crate, 10.0 * n + 2.5), 0.8, f"come {n}") for n in range(9)]
    assert linked(moves(removed, added)) == {(n, n) for n in range(9)}


def test_a_fragment_beside_the_place_is_no_twin_of_the_whole() -> None:
    crate = box((1.0, 0.7, 0.6), "lrfb")
    fragment = shifted(crate[crate[:, 0] > 0.7], 1.3)
    found = moves([crate, fragment], [shifted(crate, 4.0)])
    assert linked(found) == {(0, 0)}


def test_a_crate_a_fifth_larger_is_no_twin_though_it_is_nearer() -> None:
    crate = box((1.0, 0.7, 0.6), "lrfb")
    assert linked(moves([crate], [shifted(1.2 * crate, 2.0), shifted(crate, 9.0)])) == {(0, 1)}


def leaning(points: Float64Array, lean_deg: float, towards_deg: float) -> Float64Array:
    """Points in a map that is tilted towards a heading."""
    turn = Rotation.from_euler("zyz", [-towards_deg, lean_deg, towards_deg], degrees=True).as_matrix()
    return points @ turn.T


@pytest.mark.parametrize(("lean_deg", "yaw_rad"), [(9.0, 2.2), (12.0, 3.1)])
def test_a_chair_that_leans_with_its_map_is_the_one_that_leant_another_way_elsewhere(
    lean_deg: float, yaw_rad: float
) -> None:
    # Drift in roll and pitch tilts a map differently at each place. Each session sees another side, 2 cm thick.
    whole, pose, middle = chair(), yaw_pose(yaw_rad, (6.0, 2.0, 0.0)), np.array([[0.25, 0.25, 0.475]])
    front, back = whole[whole[:, 1] < 0.3], whole[whole[:, 1] > 0.2]
    start = leaning(front, lean_deg, 20.0)
    end = transform(pose, leaning(back, lean_deg, 160.0))
    (move,) = moves([noisy(start, "a", 0.02)], [noisy(end, "b", 0.02)])
    went = transform(pose, leaning(middle, lean_deg, 160.0)) - leaning(middle, lean_deg, 20.0)
    np.testing.assert_allclose(move.displacement_map, went[0], atol=0.12)
    # a barrel that leans is no chair
    there = transform(pose, leaning(barrel(), lean_deg, 160.0))
    assert moves([noisy(start, "a", 0.02)], [noisy(there, "b", 0.02)]) == []


def test_an_object_of_which_one_session_saw_a_part_is_the_whole_one() -> None:
    tall = box((0.5, 0.4, 1.3), "lrfb")
    lower = tall[tall[:, 2] < 0.7]  # something hides the rest
    for ends in ((lower, tall), (tall, lower)):
        assert len(moves([noisy(ends[0], "a")], [noisy(shifted(ends[1], 8.0), "b")])) == 1
    # half as much is too little, and a lower box is another object: its lid is where the tall one has none
    small = tall[tall[:, 2] < 0.35]
    assert moves([noisy(tall, "a")], [noisy(shifted(small, 8.0), "b")]) == []
    assert moves([noisy(tall, "a")], [noisy(shifted(box((0.5, 0.4, 0.5), "lrfb"), 8.0), "b")]) == []


def test_a_chair_seen_from_another_side_went_near_and_not_to_where_an_equal_one_came() -> None:
    # `regions/site1` 10040, centimetres: a chair that went 4.6 m and was turned by 165 degrees, and one that came 79 m
    # away and was seen from the side from which the former had been seen
    chairs = {name: cm / 100.0 for name, cm in np.load(Path(__file__).with_name("chairs.npz")).items()}
    for order in (("moved", "added"), ("added", "moved")):
        (move,) = moves([chairs["removed"]], [chairs[name] for name in order])
        assert order[move.added] == "moved"
        assert np.linalg.norm(move.displacement_map) == pytest.approx(4.61, abs=0.1)
