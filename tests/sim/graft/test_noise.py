"""The noise of a recording, against recordings whose noise is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from cdpipe.io.session import ScanChunk, Session
from cdpipe.sensor.ouster import SensorMetadata
from sim.graft.noise import find_bins, measure_noise
from sim.graft.part import Part

HALF_M = np.array([5.0, 3.0, 1.6])  # of a room


@dataclass(frozen=True, slots=True, eq=False)
class Room(Session):
    """Revolutions in a smooth room, noise of one sigma, a share of the beams lost."""

    sigma_m: float = 0.0
    lost: float = 0.0
    step_mm: int = 1

    def chunk(self, index: int) -> ScanChunk:
        draw = np.random.default_rng(5)
        directions, origins = self.sensor.directions, self.sensor.origins
        with np.errstate(divide="ignore"):
            reach = ((np.sign(directions) * HALF_M - origins) / directions).min(axis=-1)
        shape = (self.n_scans, *reach.shape)
        range_m = reach + self.sensor.beam_origin_m + self.sigma_m * draw.standard_normal(shape)
        range_mm = np.uint32(np.rint(range_m * 1000.0 / self.step_mm) * self.step_mm)
        range_mm[draw.random(shape) < self.lost] = 0
        poses = np.tile(np.float32([0, 0, 0, 0, 0, 0, 1]), (self.n_scans, self.sensor.width, 1))
        bright = np.where(range_mm > 4000, 50, 9)
        return ScanChunk(range_mm, np.uint8(bright), np.uint16(bright + 1), np.zeros(poses.shape[:2], np.int64), poses)


def in_a_room(recording: Session, sensor: SensorMetadata, **told: float) -> list[Part]:
    poses = np.tile(make_pose(), (6, 1, 1))
    room = Room(recording.path, sensor, poses, 6, {}, **told)
    return [Part("before", room, np.arange(6), np.eye(4))]


@pytest.mark.parametrize("sigma_m", [0.004, 0.012, 0.03])
def test_the_noise_of_smooth_walls_is_found(recording: Session, sensor: SensorMetadata, sigma_m: float) -> None:
    noise = measure_noise(in_a_room(recording, sensor, sigma_m=sigma_m))
    told = noise.describe()
    (number,) = find_bins(np.array([3.5]))
    assert told["n_residuals"][number] > 1000
    assert told["sigma_m"][number] == pytest.approx(sigma_m, rel=0.15)
    drawn = noise.draw(np.full(20_000, 3.5), np.random.default_rng(1).random(20_000))
    assert np.median(drawn) == pytest.approx(0, abs=0.02 * sigma_m)
    assert drawn.std() == pytest.approx(sigma_m, rel=0.15)


def test_without_noise_only_the_step_of_the_ranges_is_left(recording: Session, sensor: SensorMetadata) -> None:
    noise = measure_noise(in_a_room(recording, sensor))
    assert np.abs(noise.residual_m[find_bins(np.array([3.5]))[0]]).max() < 1e-3
    assert noise.step_mm == 1
    assert measure_noise(in_a_room(recording, sensor, step_mm=8)).step_mm == 8


def test_lost_beams_are_counted(recording: Session, sensor: SensorMetadata) -> None:
    noise = measure_noise(in_a_room(recording, sensor, sigma_m=0.005, lost=0.07))
    (number,) = find_bins(np.array([3.5]))
    assert noise.lost[number] == pytest.approx(0.07, abs=0.01)
    assert measure_noise(in_a_room(recording, sensor)).lost.max() == 0


def test_returns_are_as_bright_as_those_recorded_at_that_range(recording: Session, sensor: SensorMetadata) -> None:
    intensity = measure_noise(in_a_room(recording, sensor)).intensity
    near, far = find_bins(np.array([3.5, 5.0]))
    assert set(map(tuple, intensity[near].tolist())) == {(9, 10)}
    assert set(map(tuple, intensity[far].tolist())) == {(50, 51)}


def test_a_bin_without_returns_takes_its_neighbour(recording: Session, sensor: SensorMetadata) -> None:
    noise = measure_noise(in_a_room(recording, sensor, sigma_m=0.01))
    assert noise.n_residuals[-1] == 0
    np.testing.assert_array_equal(noise.residual_m[-1], noise.residual_m[find_bins(np.array([50.0]))[0]])
    assert noise.residual_m[-1].any()


def test_a_recording_without_returns_is_refused(recording: Session, sensor: SensorMetadata) -> None:
    (part,) = in_a_room(recording, sensor, lost=1.0)
    with pytest.raises(InputError, match="too few returns"):
        measure_noise([replace(part)])
