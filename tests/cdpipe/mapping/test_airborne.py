"""Returns of mist and dust are dropped, and clear air changes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import cdpipe
from cdpipe.core.geometry import Float64Array, Int32Array
from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from cdpipe.mapping import airborne, mapping
from cdpipe.mapping.airborne import ClearScans, LiesOnSurface, clear_air, drop_airborne, returns_of
from cdpipe.mapping.counted import CountedScans
from cdpipe.mapping.free_space import PIXEL_HEIGHT_RAD, free_space_votes, is_veiled, render_view
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import MapConfig, load_config
from cdpipe.model.types import KeyframeViews, PointMap, PosedScan, WrappedScans
from scenarios import load_scenario
from sim.sensor.air import AIR
from sim.session.simulate import simulate_pair
from sim.session.truth import read_labels
from tests.cdpipe.rooms import RoomScans

WIDTH = 100


def scan_of(ranges_m: Float64Array, signal: Int32Array) -> PosedScan:
    """One row of beams over a sixth of a turn; a range of 0 is a miss."""
    azimuth = np.linspace(0.0, np.pi / 3, WIDTH)
    points = ranges_m[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(WIDTH)])
    is_hit = ranges_m > 0
    pixels = (WIDTH + np.flatnonzero(is_hit)).astype(np.int32)
    stamps_ns = np.arange(is_hit.sum(), dtype=np.int64)
    return PosedScan(0, points[is_hit], np.eye(4), stamps_ns, pixels, signal[is_hit].astype(np.uint16))


def wall(signal: int = 60) -> tuple[Float64Array, Int32Array]:
    return np.linspace(4.0, 9.0, WIDTH), np.full(WIDTH, signal, np.int32)


def dropped(scan: PosedScan) -> list[int]:
    return sorted(set((scan.pixels - WIDTH).tolist()) - set((drop_airborne(scan).pixels - WIDTH).tolist()))


MIST = [10, 20, 50, 51, 80, 90]


def in_mist(ranges_m: Float64Array, signal: Int32Array) -> tuple[Float64Array, Int32Array]:
    """Six weak returns in front of the wall: enough for a dusty scan."""
    ranges_m[MIST], signal[MIST] = (2.2, 1.2, 4.0, 3.1, 6.0, 3.9), 7
    return ranges_m, signal


def test_weak_returns_in_front_of_a_wall_are_dropped() -> None:
    scan = scan_of(*in_mist(*wall()))
    left = drop_airborne(scan)
    assert dropped(scan) == MIST
    assert left.signal is not None and len(left.points_sensor) == len(left.stamps_ns) == len(left.signal) == 94
    kept = np.isin(scan.pixels, left.pixels)
    assert (left.points_sensor == scan.points_sensor[kept]).all() and (left.stamps_ns == scan.stamps_ns[kept]).all()
    assert left.airborne_sensor is not None and (left.airborne_sensor == scan.points_sensor[~kept]).all()


def test_strong_returns_and_surfaces_stay() -> None:
    ranges_m, signal = in_mist(*wall())
    ranges_m[30], signal[30] = 2.0, 40  # a lone wire that shines
    ranges_m[60:64], signal[60:64] = 4.0, 9  # a dark post, four beams wide
    assert dropped(scan_of(ranges_m, signal)) == MIST
    # a dark wall: its ranges agree; but around the mist fewer neighbours are left
    ranges_m, signal = in_mist(wall()[0], np.full(WIDTH, 12, np.int32))
    lost = dropped(scan_of(ranges_m, signal))
    assert set(MIST) <= set(lost) and len(lost) <= 2 * len(MIST)


def test_what_is_near_and_nearly_black_is_mist_though_it_looks_like_a_surface() -> None:
    ranges_m, signal = in_mist(*wall())
    ranges_m[60:70], signal[60:70] = 1.5, 8
    assert dropped(scan_of(ranges_m, signal)) == sorted([*MIST, *range(60, 70)])
    signal[60:70] = 12
    assert dropped(scan_of(ranges_m, signal)) == MIST
    # nearer still
    ranges_m[60:70] = 0.6
    assert dropped(scan_of(ranges_m, signal)) == sorted([*MIST, *range(60, 70)])
    signal[60:70] = 20
    assert dropped(scan_of(ranges_m, signal)) == MIST
    dark = scan_of(np.full(WIDTH, 1.5), np.full(WIDTH, 8))
    assert drop_airborne(dark) is dark  # nothing would be left


def test_a_place_from_which_returns_were_dropped_was_not_seen_through() -> None:
    # a dark patch of the wall, twenty beams wide and as rough as mist, is dropped; the wall behind it goes on at 7 m
    ranges_m, signal = np.full(WIDTH, 7.0), np.full(WIDTH, 60, np.int32)
    ranges_m[40:60], signal[40:60] = 4.0 + 0.5 * (np.arange(20) % 3), 9
    scan = drop_airborne(scan_of(ranges_m, signal))
    assert len(scan.points_sensor) == WIDTH - 20 and scan.airborne_sensor is not None
    patch = scan.airborne_sensor
    # beams above and below meet the wall alone
    level = scan_of(np.full(WIDTH, 7.0), signal).points_sensor
    beside = [level + np.array([0.0, 0.0, 7.0 * rows * PIXEL_HEIGHT_RAD]) for rows in (0.5, -1.5)]
    images = [render_view(np.concatenate([scan.points_sensor, *beside]), airborne) for airborne in (None, patch)]
    votes = [free_space_votes(patch, KeyframeViews(image[None], np.eye(4)[None])) for image in images]
    assert votes[0].max() == 1 and votes[1].max() == 0
    # what lies behind the dropped returns was hidden by them; what the session saw, or what a wall hides, was not
    behind, beyond = 1.5 * patch, 1.2 * level
    views = [KeyframeViews(image[None], np.eye(4)[None]) for image in images]
    assert is_veiled(behind, views[1]).all() and not is_veiled(behind, views[0]).any()
    assert not is_veiled(0.5 * level[:20], views[1]).any() and not is_veiled(beyond[:20], views[1]).any()
    # a kept return of the same pixel decides: here the mist in front of it was dropped
    plain = render_view(scan.points_sensor)
    assert np.array_equal(render_view(scan.points_sensor, 0.5 * scan.points_sensor), plain)


def test_only_a_dusty_scan_loses_returns() -> None:
    ranges_m, signal = wall()
    ranges_m[20], signal[20] = 1.2, 7
    one = scan_of(ranges_m, signal)
    assert drop_airborne(one) is one  # one in a hundred, as in clear air
    ranges_m[40], signal[40] = 1.9, 7
    assert dropped(scan_of(ranges_m, signal)) == [20, 40]
    # a dark wall that runs away from beam to beam is no dust: its ranges follow a line
    steep = scan_of(np.linspace(3.0, 19.0, WIDTH) ** 1.05, np.full(WIDTH, 12))
    assert drop_airborne(steep) is steep


class Held(WrappedScans):
    """A session of one scan."""

    def __init__(self, held: PosedScan) -> None:
        self._held = held

    @property
    def odom_T_sensor(self) -> Float64Array:
        return self._held.odom_T_sensor[None]

    def scan(self, index: int) -> PosedScan:
        return self._held


@pytest.mark.parametrize("is_dusty", [False, True])
def test_a_scan_of_clear_air_is_examined_once_and_a_dusty_one_again(
    is_dusty: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = scan_of(*(in_mist(*wall()) if is_dusty else wall()))
    examined: list[int] = []

    def examine(scan: PosedScan, lies_on_surface: LiesOnSurface | None) -> PosedScan:
        examined.append(scan.index)
        return drop_airborne(scan, lies_on_surface)

    monkeypatch.setattr(airborne, "drop_airborne", examine)
    cleared = ClearScans(Held(scan))
    scans = [cleared.scan(0) for _ in range(2)]
    assert len(examined) == (2 if is_dusty else 1) and cleared.find_dusty().tolist() == [0] * is_dusty
    assert [len(each.pixels) for each in scans] == 2 * [len(drop_airborne(scan).pixels)]


def test_a_sensor_that_tells_no_signal_keeps_everything() -> None:
    scan = replace(scan_of(*in_mist(*wall())), signal=None)
    assert drop_airborne(scan) is scan


@cache
def misty_pair(folder: Path) -> Path:
    settings = ["after.air.mist.visibility_m=20"]
    simulate_pair(load_scenario("smoke/one_box", 3, settings), 3, folder / "pair")
    return folder / "pair"


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return misty_pair(tmp_path_factory.mktemp("misty"))


def test_nearly_all_returns_of_simulated_mist_are_dropped_and_few_of_surfaces(pair: Path) -> None:
    session = read_session(pair / "after")
    truth = np.concatenate([instance for instance, _ in read_labels(session.path, session.n_chunks)])
    source, cleared = open_session(pair / "after"), ClearScans(open_session(pair / "after"))
    seen = np.concatenate([truth[scan.index].ravel()[scan.pixels] for scan in source.scans()])
    left = np.concatenate([truth[scan.index].ravel()[scan.pixels] for scan in cleared.scans()])
    assert (seen == AIR).mean() > 0.05
    assert (left == AIR).sum() < 0.01 * (seen == AIR).sum()
    assert (left >= 0).sum() > 0.9 * (seen >= 0).sum()


def test_clear_scans_are_as_recorded(pair: Path) -> None:
    source = open_session(pair / "before")
    for one, other in zip(source.scans(), ClearScans(open_session(pair / "before")).scans(), strict=True):
        assert (one.pixels == other.pixels).all()
    assert clear_air(source, MapConfig()) is source


def test_the_map_of_a_misty_session_holds_its_surfaces(pair: Path) -> None:
    before = build_map(open_session(pair / "before"), MapConfig()).points
    cells = {tuple(each) for each in np.floor(before / 0.6).astype(int).tolist()}

    def n_off(airborne: str) -> int:
        """Count map points in cells of 0.6 m that the clear session left empty."""
        config = MapConfig.model_validate({"airborne": airborne})
        points = build_map(clear_air(open_session(pair / "after"), config), config).points
        return sum(tuple(each) not in cells for each in np.floor(points / 0.6).astype(int).tolist())

    assert n_off("drop") < 0.25 * n_off("keep")


def test_what_looks_airborne_on_a_surface_comes_back_and_the_air_does_not(
    pair: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = read_session(pair / "after")
    truth = np.concatenate([instance for instance, _ in read_labels(session.path, session.n_chunks)])
    config = MapConfig.model_validate({"airborne": "drop"})
    cleared = ClearScans(open_session(pair / "after"))
    without = build_map(ClearedOnce(cleared), config)
    whole = build_map(ClearScans(open_session(pair / "after")), config)
    seen, left = (
        truth.reshape(len(truth), -1)[each.scans_of(np.arange(len(each.return_pixels))), each.return_pixels]
        for each in (without, whole)
    )
    n_lost = sum((truth[scan.index].ravel()[scan.pixels] >= 0).sum() for scan in open_session(pair / "after").scans())
    n_lost -= (seen >= 0).sum()
    n_back = (left >= 0).sum() - (seen >= 0).sum()
    assert n_back > 0.5 * n_lost > 0
    n_air_back = (left == AIR).sum() - (seen == AIR).sum()
    assert n_air_back < 0.011 * (truth == AIR).sum()  # 1.0 %
    # the second pass moves no other return
    assert set(
        zip(without.return_pixels.tolist(), without.scans_of(np.arange(len(seen))).tolist(), strict=True)
    ) <= set(zip(whole.return_pixels.tolist(), whole.scans_of(np.arange(len(left))).tolist(), strict=True))
    # a reach of 0.2 m would take mist beside a wall for it
    monkeypatch.setattr(airborne, "_SURFACE_M", 0.2)
    loose = build_map(ClearScans(open_session(pair / "after")), config)
    pixels = loose.scans_of(np.arange(len(loose.return_pixels))), loose.return_pixels
    n_air_loose = (truth.reshape(len(truth), -1)[pixels] == AIR).sum() - (seen == AIR).sum()
    assert n_air_back < 0.25 * n_air_loose


class Sparse(RoomScans):
    """A session of every n-th return."""

    def __init__(self, every: int) -> None:
        super().__init__((), 1)
        self._every = every

    def scan(self, index: int) -> PosedScan:
        scan = super().scan(index)
        return scan.keep(scan.pixels % self._every == 0)


def test_dark_returns_come_back_from_a_surface_and_from_nowhere_else() -> None:
    room = RoomScans((), 1)
    scan = room.scan(3)
    near = np.flatnonzero(np.linalg.norm(scan.points_sensor, axis=1) < 2.9)[::7]
    on, before_it = near[::2], near[1::2]
    points, signal = scan.points_sensor.copy(), np.full(len(scan.pixels), 60, np.uint16)
    signal[near] = 5
    points[before_it] *= 0.85
    dark = replace(scan, points_sensor=points, signal=signal)
    cleared = ClearScans(Held(dark))
    assert len(near) > 500 and not np.isin(cleared.scan(3).pixels, scan.pixels[near]).any()
    for every in (1, 5):  # 0.28 of them come back to the sparse map if a cell must hold three returns
        back = np.isin(scan.pixels, supported_by_map(cleared, Sparse(every).mapped()).scan(3).pixels)
        assert back[on].mean() > 0.95 and not back[before_it].any()
    # a lone return is no surface
    lone = Sparse(211).mapped()
    assert len(lone.return_pixels) > 1000
    assert not np.isin(scan.pixels, supported_by_map(cleared, lone).scan(3).pixels)[near].any()


def supported_by_map(cleared: ClearScans, point_map: PointMap) -> ClearScans:
    return cleared.supported_by(returns_of(point_map), point_map.odom_T_sensor)


class Dimmed(WrappedScans):
    """A session of clear air in which some scans have dark returns: on the surfaces, and in front of them."""

    dark = (10, 11, 30)

    def scan(self, index: int) -> PosedScan:
        return self._dimmed(super().scan(index))

    def scans(self) -> Iterator[PosedScan]:
        return map(self._dimmed, super().scans())

    def _dimmed(self, scan: PosedScan) -> PosedScan:
        if scan.index not in self.dark:
            return scan
        assert scan.signal is not None
        points, signal = scan.points_sensor.copy(), scan.signal.copy()
        near = np.flatnonzero(np.linalg.norm(points, axis=1) < 2.9)[::7]
        signal[near] = 5
        points[near[1::2]] *= 0.85
        return replace(scan, points_sensor=points, signal=signal)


def test_a_session_of_clear_air_is_read_once(pair: Path) -> None:
    config = MapConfig.model_validate({"airborne": "drop", "consistency": "none"})
    read: list[int] = []

    class Noted(WrappedScans):
        def scan(self, index: int) -> PosedScan:
            read.append(index)
            return super().scan(index)

        def scans(self) -> Iterator[PosedScan]:
            return map(self.scan, range(len(self.odom_T_sensor)))

    build_map(ClearScans(Noted(open_session(pair / "before"))), config)
    assert read == list(range(len(read)))


@pytest.mark.parametrize("consistency", ["none", "scan-to-map"])
def test_the_map_of_few_dusty_scans_is_made_once_and_equals_that_of_two_passes(
    consistency: str, pair: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = MapConfig.model_validate({"airborne": "drop", "consistency": consistency})
    passes: list[str] = []

    def mapped() -> PointMap:
        passes.clear()
        counted = CountedScans(Dimmed(open_session(pair / "before")), lambda step, *_: passes.append(step))
        return build_map(ClearScans(counted), config)

    once, n_once = mapped(), len(set(passes))
    monkeypatch.setattr(mapping, "FEW_SCANS", 0.0)
    twice, n_twice = mapped(), len(set(passes))
    assert n_twice == n_once + (consistency != "none")  # which needs a map to know of them
    for field in fields(once):
        one, other = getattr(once, field.name), getattr(twice, field.name)
        if field.name == "views":
            one, other = one.ranges_m, other.ranges_m
        assert np.array_equal(one, other), field.name
    # returns of the surfaces came back, those in front of them did not
    recorded = Dimmed(open_session(pair / "before"))
    for index in Dimmed.dark:
        kept = once.return_pixels[once.scan_offsets[index] : once.scan_offsets[index + 1]]
        near = recorded.scan(index).signal == 5
        assert 0.3 < np.isin(recorded.scan(index).pixels[near], kept).mean() < 0.7


class ClearedOnce(WrappedScans):
    """Scans without what looks airborne, of which the map does not know that they were cleared."""


def test_the_pipeline_sees_through_the_mist(pair: Path) -> None:
    report = cdpipe.detect(pair / "before", pair / "after")
    assert [item.kind for item in report.objects] == ["added"]


def test_presets_of_the_paper_map_what_was_recorded() -> None:
    assert load_config("paper").map.airborne == load_config("paper-paired").map.airborne == "keep"
    assert load_config("tunnelcd").map.airborne == load_config("c2c").map.airborne == "drop"
    assert "airborne" not in load_config("paper").model_dump(mode="json")["map"]
