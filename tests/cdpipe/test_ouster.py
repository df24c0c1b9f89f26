import json
from pathlib import Path

import numpy as np
import pytest

from cdpipe.errors import InputError
from cdpipe.ouster import load_profile, parse_metadata, profile_names


def test_beam_leaves_beside_the_axis_and_range_includes_that_offset() -> None:
    # column 0 looks along lidar +x, which is sensor -x; a level beam without azimuth offset
    document = {
        "beam_altitude_angles": [0.0],
        "beam_azimuth_angles": [0.0],
        "lidar_mode": "4x10",
        "lidar_origin_to_beam_origin_mm": 20.0,
        "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 30.0, 0, 0, 0, 1],
    }
    sensor = parse_metadata({**document, "beam_altitude_angles": [10.0, 0.0], "beam_azimuth_angles": [0.0, 0.0]}, "t")
    points = sensor.project(np.full((2, 4), 5.0))
    np.testing.assert_allclose(points[1, 0], [-5.0, 0.0, 0.03], atol=1e-12)
    # the head spins clockwise: a quarter turn later the beam looks along lidar -y, which is sensor +y
    np.testing.assert_allclose(points[1, 1], [0.0, 5.0, 0.03], atol=1e-12)
    # 10 deg up: 20 mm to the beam origin, then 4.98 m along the beam
    up = np.deg2rad(10.0)
    np.testing.assert_allclose(points[0, 0], [-0.02 - 4.98 * np.cos(up), 0, 0.03 + 4.98 * np.sin(up)], atol=1e-12)


def test_positive_azimuth_offset_turns_the_beam_clockwise() -> None:
    nominal = load_profile("os1-32-nominal")
    first = nominal.directions[0, 0]
    heading_deg = np.rad2deg(np.arctan2(first[1], first[0])) % 360
    assert heading_deg == pytest.approx(180.0 - 4.23)


def test_shipped_profiles_are_complete_and_survive_a_round_trip() -> None:
    assert {"os1-32-nominal", "os1-32-u0"} <= set(profile_names())
    for name in profile_names():
        sensor = load_profile(name)
        again = parse_metadata(json.loads(json.dumps(sensor.to_json())), name)
        assert (sensor.height, sensor.width, sensor.rate_hz) == (32, 1024, 10.0)
        np.testing.assert_allclose(again.project(np.ones((32, 1024))), sensor.project(np.ones((32, 1024))), atol=1e-15)


def test_another_mode_changes_columns_and_stamps() -> None:
    sensor = load_profile("os1-32-u0", mode="512x20")
    assert sensor.directions.shape == (32, 512, 3)
    assert sensor.column_offsets_ns()[1] == pytest.approx(1e9 / 20 / 512)


def test_nested_metadata_of_newer_firmware_is_read() -> None:
    flat = load_profile("os1-32-u0").to_json()
    nested = {
        "sensor_info": {"prod_line": flat["prod_line"], "prod_sn": "1"},
        "config_params": {"lidar_mode": flat["lidar_mode"]},
        "beam_intrinsics": {key: flat[key] for key in flat if key.startswith(("beam_", "lidar_origin"))},
        "lidar_intrinsics": {"lidar_to_sensor_transform": flat["lidar_to_sensor_transform"]},
        "lidar_data_format": flat["data_format"],
    }
    one, other = parse_metadata(flat, "flat"), parse_metadata(nested, "nested")
    np.testing.assert_array_equal(one.directions, other.directions)
    assert one.pixel_shift == other.pixel_shift


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"beam_altitude_angles": None}, "beam_altitude_angles is missing"),
        ({"beam_azimuth_angles": [1.0]}, "equally long"),
        ({"beam_azimuth_angles": ["left"]}, "lists of numbers"),
        ({"beam_altitude_angles": list(range(32))}, "must fall"),
        ({"lidar_mode": "fast"}, "expected <columns>x<Hz>"),
        ({"lidar_to_sensor_transform": [1, 2]}, "16 numbers"),
    ],
)
def test_bad_metadata_is_named(tmp_path: Path, change: dict[str, object], message: str) -> None:
    document = {**load_profile("os1-32-u0").to_json(), **change}
    path = tmp_path / "sensor.json"
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}))
    with pytest.raises(InputError, match=message) as caught:
        load_profile(str(path))
    assert str(path) in str(caught.value)


def test_unknown_profile_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="os1-32-nominal"):
        load_profile("os1-64")
