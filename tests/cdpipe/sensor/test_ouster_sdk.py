"""The beam table against the vendor's SDK, for every profile and mode."""

import json

import numpy as np
import pytest

from cdpipe.sensor.ouster import SensorMetadata, load_profile, parse_metadata, profile_names
from cdpipe.sensor.ouster_metadata import MODES

core = pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")


def random_ranges_mm(sensor: SensorMetadata) -> np.ndarray:
    draw = np.random.default_rng(3)
    return draw.integers(300, 120_000, size=(sensor.height, sensor.width)).astype(np.uint32)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", profile_names())
def test_points_are_where_the_vendor_has_them(name: str, mode: str) -> None:
    sensor = load_profile(name, mode)
    info = core.SensorInfo(json.dumps(sensor.to_json()))
    ranges_mm = random_ranges_mm(sensor)
    vendor = core.XYZLut(info, use_extrinsics=False)(ranges_mm)
    np.testing.assert_allclose(sensor.project(ranges_mm / 1000.0), vendor, atol=1e-6)
    assert (info.w, info.h, info.format.fps) == (sensor.width, sensor.height, sensor.rate_hz)
    assert tuple(info.format.pixel_shift_by_row) == sensor.pixel_shift
    staggered = np.arange(sensor.width * sensor.height).reshape(sensor.height, sensor.width)
    rolled = np.stack([np.roll(row, shift) for row, shift in zip(staggered, sensor.pixel_shift, strict=True)])
    np.testing.assert_array_equal(core.destagger(info, staggered), rolled)


@pytest.mark.parametrize("name", profile_names())
def test_metadata_that_the_vendor_wrote_gives_the_same_beams(name: str) -> None:
    sensor = load_profile(name, "512x20")
    nested = core.SensorInfo(json.dumps(sensor.to_json())).to_json_string()
    assert "beam_intrinsics" in json.loads(nested)
    again = parse_metadata(json.loads(nested), "written by the SDK")
    assert (again.product, again.mode, again.pixel_shift) == (sensor.product, sensor.mode, sensor.pixel_shift)
    np.testing.assert_array_equal(again.directions, sensor.directions)
    np.testing.assert_allclose(again.origins, sensor.origins, atol=1e-15)


@pytest.mark.parametrize("line", ["OS-0-32-U1", "OS-1-32-A02", "OS-2-32-BH02", "OS-DOME-32"])
def test_a_beam_origin_that_is_not_stated_is_the_vendors(line: str) -> None:
    document = {**load_profile("os1-32-gen1").to_json(), "prod_line": line}
    del document["lidar_origin_to_beam_origin_mm"]
    vendor = core.SensorInfo(json.dumps(document)).lidar_origin_to_beam_origin_mm
    assert parse_metadata(document, line).beam_origin_m == pytest.approx(vendor / 1000.0, abs=1e-12)


def test_the_transform_goes_before_the_single_figure_as_with_the_vendor() -> None:
    matrix = [1, 0, 0, 20.0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    document = {**load_profile("os1-32-u0").to_json(), "beam_to_lidar_transform": matrix}
    sensor = parse_metadata(document, "t")
    assert sensor.beam_origin_m == 0.02
    ranges_mm = random_ranges_mm(sensor)
    vendor = core.XYZLut(core.SensorInfo(json.dumps(document)), use_extrinsics=False)(ranges_mm)
    np.testing.assert_allclose(sensor.project(ranges_mm / 1000.0), vendor, atol=1e-6)
