"""Metadata of another sensor is noticed by the shift of neighbouring beams."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.io.ouster.beams import check_beams
from cdpipe.sensor.ouster import SensorMetadata, load_profile

MODE = "1024x10"
HALF_ROOM_M = (6.0, 4.0, 2.5)


def room(sensor: SensorMetadata) -> np.ndarray:
    """Return the ranges (H, W), millimetres, to the walls of a box; a tenth of the returns is missing."""
    with np.errstate(divide="ignore"):
        reach_m = ((np.sign(sensor.directions) * HALF_ROOM_M) / sensor.directions).min(axis=-1)
    rng = np.random.default_rng(3)
    ranges = np.round(1000 * reach_m * rng.normal(1.0, 0.002, reach_m.shape)).astype(np.uint32)
    ranges[rng.random(ranges.shape) < 0.1] = 0
    return ranges


@pytest.mark.parametrize("name", ["os1-32-g", "os1-32-nominal", "os1-32-u0", "os0-128-nominal"])
def test_the_sensor_itself_fits(name: str) -> None:
    sensor = load_profile(name, MODE)
    check_beams(room(sensor), sensor, Path("m.json"), Path("a.pcap"))


@pytest.mark.parametrize(("made", "told"), [("os1-32-g", "os1-32-u0"), ("os1-32-u0", "os1-32-nominal")])
def test_another_one_does_not(made: str, told: str) -> None:
    with pytest.raises(InputError, match=r"m\.json: not the metadata of the sensor that made a\.pcap"):
        check_beams(room(load_profile(made, MODE)), load_profile(told, MODE), Path("m.json"), Path("a.pcap"))


def test_noise_tells_nothing() -> None:
    ranges = np.random.default_rng(4).integers(0, 60_000, (32, 1024)).astype(np.uint32)
    for name in ("os1-32-g", "os1-32-u0"):
        check_beams(ranges, load_profile(name, MODE), Path("m.json"), Path("a.pcap"))


@pytest.mark.skipif("TUNNELCD_REAL_DATA" not in os.environ, reason="real recordings: TUNNELCD_REAL_DATA is not set")
def test_a_real_capture_without_serial_number() -> None:
    pytest.importorskip("ouster.sdk")
    from cdpipe.io.ouster.captures import open_recording  # noqa: PLC0415 - only where the extra is installed

    path = Path(os.environ["TUNNELCD_REAL_DATA"]) / "ouster" / "OS-1-32-G_v2.1.1_1024x10.pcap"
    recording = open_recording(path)
    ranges = next(iter(recording.revolutions())).range_mm
    check_beams(ranges, recording.sensor, path, path)
    with pytest.raises(InputError, match="elsewhere than those of"):
        check_beams(ranges, load_profile("os1-32-u0", MODE), path, path)
