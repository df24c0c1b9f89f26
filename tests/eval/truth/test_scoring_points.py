"""The scoring points against a dictionary of cells, its lookups, its cache, and labels that do not belong."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import transform
from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from cdpipe.model.types import PosedScan
from eval.truth import scoring_points as module
from eval.truth.ground_truth import load_ground_truth
from eval.truth.scoring_points import ScoringPoints, ScoringPointsBuilder, build_scoring_points, load_scoring_points
from sim.session.truth import MIXED, read_labels, read_true_poses, write_labels, write_true_poses


def points_by_dictionary(session: Path) -> dict[tuple[int, ...], tuple[int, int, int, int, np.ndarray]]:
    """Scan, pixel, change, instance and point of the first return of each cell, a mixed one if there is no other."""
    opened = read_session(session)
    labels = list(read_labels(session, opened.n_chunks))
    instance, change = (np.concatenate([chunk[part] for chunk in labels]) for part in (0, 1))
    first: dict[tuple[int, ...], tuple[int, int, int, int, np.ndarray]] = {}
    for scan in open_session(session).scans():
        points = transform(scan.odom_T_sensor, scan.points_sensor)
        for pixel, point in zip(scan.pixels.tolist(), points, strict=True):
            row, column = divmod(pixel, opened.sensor.width)
            labelled = (int(change[scan.index, row, column]), int(instance[scan.index, row, column]))
            cell = tuple(np.floor(point / 0.1))
            if cell not in first or (first[cell][2] == MIXED and labelled[0] != MIXED):
                first[cell] = (scan.index, pixel, *labelled, point)
    return first


def mix(session: Path, share: float, seed: int = 0) -> None:
    """Make this share of a session's returns mixed."""
    rng = np.random.default_rng(seed)
    for index, (instance, change) in enumerate(list(read_labels(session, read_session(session).n_chunks))):
        is_mixed = (instance >= 0) & (rng.random(instance.shape) < share)
        write_labels(session, index, instance, np.where(is_mixed, MIXED, change).astype(np.int16))


@pytest.mark.parametrize(("batch", "pending"), [(500_000, 4_000_000), (300, 10), (1, 1)])
@pytest.mark.parametrize(("name", "mixed"), [("before", 0.0), ("after", 0.0), ("after", 0.4)])
def test_equals_a_dictionary_of_cells(
    tiny_pair: Path, name: str, mixed: float, batch: int, pending: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_BATCH_RETURNS", batch)
    monkeypatch.setattr(module, "_PENDING_ROWS", pending)
    session = tiny_pair / name
    mix(session, mixed)
    built = build_scoring_points(read_session(session))
    expected = sorted(points_by_dictionary(session).values(), key=lambda row: row[:2])
    every = np.arange(len(built))
    assert len(built) == len(expected)
    assert list(zip(built.scans(every), built.pixels(every), strict=True)) == [row[:2] for row in expected]
    assert built.change.tolist() == [row[2] for row in expected]
    assert built.instance.tolist() == [row[3] for row in expected]
    np.testing.assert_allclose(built.points_odom, [row[4] for row in expected], atol=1e-5)
    assert set(built.change.tolist()) == ({0, 2} if name == "before" else {0, 1, 3}) | ({MIXED} if mixed else set())


def test_a_mixed_return_is_a_row_only_where_its_cell_has_no_other() -> None:
    builder = ScoringPointsBuilder("by hand", 1, 6)
    x_m = np.array([0.01, 0.02, 0.03, 0.31, 0.32, 0.61])  # three cells
    points = np.column_stack([x_m, np.zeros((6, 2))])
    for index, change in enumerate(([-1, 5, -1, -1, -1, 0], [7, 7, 7, -1, 3, -1])):
        scan = PosedScan(index, points, np.eye(4), np.zeros(6, np.int64), np.arange(6, dtype=np.int32))
        builder.add(scan, np.zeros((1, 6), np.int16), np.array([change], np.int16))
        if index == 0:
            first = builder.finish(1)
    assert (first.returns.tolist(), first.change.tolist()) == ([1, 3, 5], [5, MIXED, 0])
    whole = builder.finish(2)
    assert (whole.returns.tolist(), whole.change.tolist()) == ([1, 5, 10], [5, 0, 3])
    assert whole.nearest_m.tolist() == pytest.approx([np.inf, np.inf, np.inf, 0.32, np.inf, 0.02, np.inf, 0.01])


@pytest.mark.parametrize(
    ("x_m", "change", "returns", "labels"),
    [
        ((0.01, 0.31, 0.02), (MIXED, 0, 5), [1, 2], [0, 5]),  # another cell lies between the two of one cell
        ((0.01, 0.31, 0.32), (0, MIXED, 6), [0, 2], [0, 6]),  # a mixed one before another of its cell
        ((0.01, 0.02, 0.03), (MIXED, MIXED, MIXED), [0], [MIXED]),
        ((0.01, 0.02, 0.03), (4, MIXED, 5), [0], [4]),
    ],
)
def test_the_first_return_of_a_cell_that_is_not_mixed_is_its_row(
    x_m: tuple[float, ...], change: tuple[int, ...], returns: list[int], labels: list[int]
) -> None:
    builder = ScoringPointsBuilder("by hand", 1, 3)
    points = np.column_stack([x_m, np.zeros((3, 2))])
    scan = PosedScan(0, points, np.eye(4), np.zeros(3, np.int64), np.arange(3, dtype=np.int32))
    builder.add(scan, np.zeros((1, 3), np.int16), np.array([change], np.int16))
    found = builder.finish(1)
    assert (found.returns.tolist(), found.change.tolist()) == (returns, labels)


def test_rows_are_found_again_by_their_returns(tiny_pair: Path) -> None:
    built = load_scoring_points(tiny_pair / "after")
    chosen = np.array([0, 5, len(built) - 1])
    returns = np.column_stack([built.scans(chosen), built.pixels(chosen)]).astype(np.int32)
    assert built.rows_of_returns(returns[::-1]).tolist() == chosen.tolist()
    assert built.rows_of_returns(np.zeros((0, 2), dtype=np.int32)).tolist() == []
    # pixel 0 is a miss in every scan
    assert built.rows_of_returns(np.array([[0, 0], [13, 0]], dtype=np.int32)).tolist() == []


def test_the_cache_is_used_until_the_session_changes(tiny_pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = tiny_pair / "after"
    built = load_scoring_points(session)
    with monkeypatch.context() as patch:
        patch.setattr(module, "build_scoring_points", lambda _: pytest.fail("built again"))
        cached = load_scoring_points(session)
    for name in ("returns", "points_odom", "change", "instance"):
        np.testing.assert_array_equal(getattr(cached, name), getattr(built, name))
        assert getattr(cached, name).dtype == getattr(built, name).dtype
    assert (cached.n_scans, cached.n_pixels) == (built.n_scans, built.n_pixels)

    instance, change = next(read_labels(session, 1))
    write_labels(session, 0, instance, np.where(change == 1, 9, change).astype(np.int16))
    assert 9 in load_scoring_points(session).change


def test_a_damaged_cache_is_built_again(tiny_pair: Path) -> None:
    session = tiny_pair / "after"
    built = load_scoring_points(session)
    (session / "truth" / "scoring_points.npz").write_bytes(b"PK\x03\x04 not an archive")
    np.testing.assert_array_equal(load_scoring_points(session).returns, built.returns)


@pytest.mark.parametrize(
    ("place", "number", "is_used"),
    [(0, -1, False), (0, 0, True), (1, "as the first", False), (-1, 14 * 4 * 64, False), (-1, 14 * 4 * 64 - 1, True)],
)
def test_a_cache_that_names_returns_that_are_not_there_is_built_again(
    tiny_pair: Path, place: int, number: int | str, is_used: bool
) -> None:
    session = tiny_pair / "after"
    built = load_scoring_points(session)
    path = session / "truth" / "scoring_points.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays["returns"][place] = arrays["returns"][0] if number == "as the first" else number
    arrays["points_odom"] += 1.0
    np.savez(path, **arrays)
    expected = arrays["points_odom"] if is_used else built.points_odom
    np.testing.assert_array_equal(load_scoring_points(session).points_odom, expected)


@pytest.mark.parametrize(("place_m", "is_used"), [(104_857.5, True), (104_858.0, False), (-104_858.0, False)])
def test_a_cache_with_points_beyond_all_cells_is_built_again(tiny_pair: Path, place_m: float, is_used: bool) -> None:
    session = tiny_pair / "after"
    built = load_scoring_points(session)
    path = session / "truth" / "scoring_points.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays["points_odom"][5, 1] = place_m
    np.savez(path, **arrays)
    expected = arrays["points_odom"] if is_used else built.points_odom
    np.testing.assert_array_equal(load_scoring_points(session).points_odom, expected)


def test_truth_that_is_too_far_away_is_one_line(tiny_pair: Path) -> None:
    poses = read_true_poses(tiny_pair / "before")
    poses[3, 0, 3] = 1e200
    write_true_poses(tiny_pair / "before", poses)
    with pytest.raises(InputError, match=r"poses\.npz: damaged: a pose is farther than 1e\+07 m"):
        load_ground_truth(tiny_pair)
    changes = tiny_pair / "truth" / "changes.json"
    document = json.loads(changes.read_text())
    document["changes"][1]["world_T_object"][0][3] = 1e308
    changes.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"changes\.json: damaged: changes\.1: farther"):
        load_ground_truth(tiny_pair)


@pytest.mark.parametrize(
    ("at", "wrong", "expected"),
    [
        (0, {"id": 2}, "changes: id 2 stands there 2 times"),
        (0, {"kind": "moved", "partner": 2}, "changes 1 and 2 are not the halves of one move"),
        (1, {"session": "after"}, "changes 2 and 3 are not the halves of one move"),
        (2, {"partner": 1}, "changes 2 and 3 are not the halves of one move"),
    ],
)
def test_changes_that_contradict_each_other_are_one_line(
    tiny_pair: Path, at: int, wrong: dict[str, object], expected: str
) -> None:
    path = tiny_pair / "truth" / "changes.json"
    document = json.loads(path.read_text())
    assert [each["partner"] for each in document["changes"]] == [None, 3, 2]
    document["changes"][at] |= wrong
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"changes\.json: damaged: {expected}"):
        load_ground_truth(tiny_pair)


def test_labels_of_another_session_are_refused(tiny_pair: Path) -> None:
    session = tiny_pair / "before"
    write_labels(session, 1, np.zeros((5, 4, 32), np.int16), np.zeros((5, 4, 32), np.int16))
    with pytest.raises(InputError, match=r"labels of chunk 1 are \(5, 4, 32\)"):
        load_scoring_points(session)
    (session / "truth" / "00001.npz").unlink()
    with pytest.raises(InputError, match=r"00001\.npz: missing"):
        load_scoring_points(session)


def few_points(n: int, nearest_m: tuple[float, ...] = ()) -> ScoringPoints:
    zeros = np.zeros(n, dtype=np.int16)
    returns = 5 + 3 * np.arange(n)
    return ScoringPoints(returns, np.zeros((n, 3), np.float32), zeros, zeros, 4, 10, np.array(nearest_m, np.float32))


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_every_row_is_found_however_few_there_are(n: int) -> None:
    points = few_points(n)
    every = np.column_stack([np.repeat(np.arange(4), 10), np.tile(np.arange(10), 4)])
    found = points.rows_of_returns(every)
    assert found.tolist() == list(range(n)) and found.dtype == np.int64
    assert points.rows_of_returns(every[::-1][:5]).tolist() == []
    # 5, 8 and 11 are (scan 0, pixel 5), (0, 8) and (1, 1)
    rows = np.arange(n)
    assert list(zip(points.scans(rows), points.pixels(rows), strict=True)) == [(0, 5), (0, 8), (1, 1)][:n]
    assert points.rows_of_returns(np.array([(1, 1), (0, 5), (0, 5)])).tolist() == [row for row in (0, 2) if row < n]


def test_the_range_of_a_change_that_no_return_met_is_undefined() -> None:
    points = few_points(1, (np.inf, 2.5, np.inf))
    assert points.range_of_change(1) == 2.5
    assert np.isnan([points.range_of_change(number) for number in (0, 2, 3, 9)]).all()
    assert np.isnan(few_points(1).range_of_change(0))


@pytest.mark.parametrize(
    ("field", "wrong"), [("points_odom", np.zeros((2, 3))), ("change", np.zeros(2)), ("instance", np.zeros(2))]
)
def test_columns_of_unequal_length_are_refused(field: str, wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match=f"^{field} must be"):
        replace(few_points(1), **{field: wrong})


def scan_of_one_row(points_sensor: list[tuple[float, float, float]], pixels: list[int]) -> PosedScan:
    stamps_ns = np.zeros(len(pixels), dtype=np.int64)
    points = np.array(points_sensor, dtype=np.float64).reshape(-1, 3)
    return PosedScan(0, points, np.eye(4), stamps_ns, np.array(pixels, dtype=np.int32))


@pytest.mark.parametrize(
    ("change", "points", "pixels", "expected"),
    [
        ((0, 0, 0, 0), [(1.0, 0, 0)], [1], []),  # a session that shows no change
        ((0, 2, 0, 0), [(3.0, 4.0, 0), (0, 0, 1.0)], [1, 2], [np.inf, np.inf, 5.0]),
        ((0, 2, 0, 0), [(0, 0, 1.0)], [2], [np.inf]),  # labelled, but its only ray came back from nowhere
        ((0, 2, 0, 0), [], [], [np.inf]),
    ],
)
def test_shortest_ranges_end_with_the_last_change_that_returned(
    change: tuple[int, ...], points: list[tuple[float, float, float]], pixels: list[int], expected: list[float]
) -> None:
    builder = ScoringPointsBuilder("one", 1, 4)
    labels = np.array([change], dtype=np.int16)
    builder.add(scan_of_one_row(points, pixels), labels, labels)
    nearest_m = builder.finish(1).nearest_m
    assert nearest_m.tolist() == expected and nearest_m.dtype == np.float32


def test_a_point_too_far_out_for_a_cell_names_its_session_and_scan(tiny_pair: Path) -> None:
    session = read_session(tiny_pair / "before")
    with np.load(session.path / "odometry.npz") as archive:
        arrays = dict(archive)
    arrays["odom_T_sensor"][2, 0, 3] = 9e6
    np.savez(session.path / "odometry.npz", **arrays)
    with pytest.raises(InputError, match=f"^{re.escape(str(session.path))}: scan 2: "):
        build_scoring_points(session)


@pytest.mark.parametrize("is_session", [True, False])
def test_nothing_is_stored_through_a_link(tiny_pair: Path, tmp_path: Path, is_session: bool) -> None:
    session, linked = tiny_pair / "after", tmp_path / "linked"
    if is_session:
        linked.symlink_to(session)
    else:
        shutil.copytree(session, linked)
        shutil.rmtree(linked / "truth")
        (linked / "truth").symlink_to(session / "truth")
    (session / "truth" / "scoring_points.npz").unlink(missing_ok=True)
    assert len(load_scoring_points(linked)) > 0
    assert not (session / "truth" / "scoring_points.npz").exists()


def test_a_place_that_cannot_be_written_is_done_without(tiny_pair: Path) -> None:
    (tiny_pair / "after" / "truth" / "scoring_points.npz").mkdir()
    assert len(load_scoring_points(tiny_pair / "after")) > 0
