import json
import re
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.sensor import ouster
from cdpipe.sensor.ouster import load_profile, parse_metadata, profile_names
from cdpipe.sensor.ouster_metadata import MODES

PROFILES = Path(ouster.__file__).parent / "profiles"


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
    assert profile_names() == [
        "os0-128-nominal", "os0-32-nominal", "os1-128-nominal", "os1-32-g", "os1-32-gen1", "os1-32-nominal",
        "os1-32-u0", "os1-64-nominal", "puck-16",
    ]  # fmt: skip
    for name in profile_names():
        sensor = load_profile(name)
        again = parse_metadata(json.loads(json.dumps(sensor.to_json())), name)
        assert (sensor.height, sensor.width, sensor.rate_hz) == (int(re.findall(r"-(\d+)", name)[0]), 1024, 10.0)
        ranges_m = np.ones((sensor.height, 1024))
        np.testing.assert_allclose(again.project(ranges_m), sensor.project(ranges_m), atol=1e-15)


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


def test_profiles_name_no_unit_and_no_host() -> None:
    for name in profile_names():
        document = json.loads((PROFILES / f"{name}.json").read_text())
        assert document["prod_sn"] in ("nominal", "calibrated")
        assert "hostname" not in document
        assert document["_source"]


def test_gradient_and_first_generation_beams() -> None:
    gradient, first = load_profile("os1-32-g"), load_profile("os1-32-gen1")
    assert (gradient.altitude_deg[0], gradient.altitude_deg[-1]) == (12.75, -15.32)
    # a beam is destaggered by as many columns of 360 / 1024 deg as its azimuth is off the smallest
    assert gradient.pixel_shift[:9] == (0, 0, 0, 0, 8, 16, 8, 0, 24)
    assert (first.altitude_deg[0], first.altitude_deg[-1]) == (15.91, -16.858)
    assert first.pixel_shift[:2] == (12, 0)
    assert first.beam_origin_m == 0.015806


def test_first_generation_lists_64_beams_and_leaves_32_at_zero() -> None:
    first = load_profile("os1-32-gen1").to_json()
    padded = {
        key: [value for angle in first[key] for value in (0, angle)]
        for key in ("beam_altitude_angles", "beam_azimuth_angles")
    }
    sensor = parse_metadata({**first, **padded}, "padded")
    np.testing.assert_array_equal(sensor.directions, load_profile("os1-32-gen1").directions)


@pytest.mark.parametrize("mode", MODES)
def test_the_shift_of_a_row_follows_the_columns(mode: str) -> None:
    sensor = load_profile("os1-32-g", mode)
    columns = int(mode.split("x", maxsplit=1)[0])
    # its eighth beam is 8.51 deg off the smallest azimuth: 24.2 of 1024 columns, 96.8 of 4096
    assert sensor.pixel_shift[8] == {512: 12, 1024: 24, 2048: 48, 4096: 97}[columns]


def other(**change: object) -> dict[str, object]:
    """The calibrated unit's metadata with some keys changed, None for left out."""
    document = {**load_profile("os1-32-u0").to_json(), **change}
    return {key: value for key, value in document.items() if value is not None}


UP_TO = [20.0 - n for n in range(32)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"beam_altitude_angles": None}, "beam_altitude_angles .*prod_line, prod_sn, lidar_mode"),
        ({"lidar_mode": None}, "lidar_mode is missing"),
        ({"beam_azimuth_angles": [1.0]}, "32 and 1"),
        ({"beam_azimuth_angles": ["left"]}, r"beam_azimuth_angles\[0\] .*'left'"),
        ({"beam_altitude_angles": [*UP_TO[:3], "12.5"]}, r"beam_altitude_angles\[3\] .*'12.5'"),
        ({"beam_altitude_angles": [True]}, r"beam_altitude_angles\[0\] .*True"),
        ({"beam_altitude_angles": [10**400]}, "beyond 64 bits"),
        ({"beam_azimuth_angles": 4.0}, "beam_azimuth_angles "),
        ({"beam_azimuth_angles": [UP_TO]}, r"beam_azimuth_angles\[0\] .*\[20.0"),
        ({"beam_azimuth_angles": {"0": 1.0}}, "beam_azimuth_angles "),
        ({"beam_altitude_angles": [*UP_TO[:5], float("nan"), *UP_TO[6:]]}, r"beam_altitude_angles\[5\] = nan"),
        ({"beam_altitude_angles": list(range(32))}, "must fall from the top beam"),
        ({"beam_altitude_angles": [20.0, *UP_TO[:31]]}, "must fall from the top beam"),
        ({"beam_altitude_angles": [100.0, *UP_TO[1:]]}, "exceed 90 deg"),
        ({"beam_azimuth_angles": [400.0] * 32}, "exceed 180 deg"),
        ({"prod_line": "OS-1-64"}, "prod_line = 'OS-1-64' .*64 .*32 "),
        ({"lidar_mode": "fast"}, "512x10, 512x20, 1024x10, 1024x20, 2048x10"),
        ({"lidar_mode": "2048x20", "data_format": None}, "'2048x20': expected one of 512x10, 512x20, 1024x10"),
        ({"lidar_mode": "512x10"}, "data_format.columns_per_frame = 1024.* 512"),
        ({"data_format": {"pixels_per_column": 64}}, "pixels_per_column = 64.* 32"),
        ({"data_format": {"pixel_shift_by_row": [1, 2]}}, "pixel_shift_by_row .*32 .*2"),
        ({"data_format": [1]}, "data_format "),
        ({"lidar_to_sensor_transform": [1, 2]}, "16 numbers, got 2"),
        ({"lidar_to_sensor_transform": [0] * 16}, "not a rigid transform"),
        ({"lidar_origin_to_beam_origin_mm": -1.0}, "-1 mm .*0 to 100 mm"),
        ({"lidar_origin_to_beam_origin_mm": 15806.0}, "15806 mm .*0 to 100 mm"),
        ({"lidar_origin_to_beam_origin_mm": float("inf")}, "inf mm"),
        ({"lidar_origin_to_beam_origin_mm": "far"}, "'far'"),
        ({"lidar_origin_to_beam_origin_mm": "15.8"}, "must be a number, got '15.8'"),
        ({"lidar_origin_to_beam_origin_mm": 10**400}, "lidar_origin_to_beam_origin_mm is beyond 64 bits"),
        ({"lidar_mode": "9" * 5000 + "x10"}, "expected <columns>x<Hz>"),
        (
            {"beam_to_lidar_transform": [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 65.0, 0, 0, 0, 1]},
            "beam_to_lidar_transform ",
        ),
    ],
)
def test_bad_metadata_is_named(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = tmp_path / "sensor.json"
    path.write_text(json.dumps(other(**change)))
    with pytest.raises(InputError, match=message) as caught:
        load_profile(str(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


VELODYNE = {"lasers": [{"laser_id": 0, "vert_correction": -0.26}], "num_lasers": 16, "distance_resolution": 0.002}
LIVOX = {"lidar_summary_info": {"lidar_type": 8}, "MID360": {"lidar_net_info": {"cmd_data_port": 56100}}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "not JSON"),
        (b" \n", "not JSON"),
        (b"\x89PNG\xff\xfe", "not JSON"),
        (b"{'a': 1}", "not JSON .*line 1"),
        (b"[1, 2]", "holds a JSON list"),
        (b'{"a": ' + b"9" * 5000 + b"}", "not JSON"),
        (b"[" * 200_000, "not JSON"),
        (json.dumps(VELODYNE).encode(), "lasers, num_lasers, distance_resolution"),
        (json.dumps(LIVOX).encode(), "lidar_summary_info, MID360"),
        (b"{}", "missing .there is nothing"),
    ],
)
def test_files_that_are_no_ouster_metadata(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "sensor.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match=message) as caught:
        load_profile(str(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json: missing: expected the metadata"):
        load_profile(str(tmp_path / "none.json"))
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(InputError, match="folder"):
        load_profile(str(tmp_path / "folder.json"))


def test_unknown_profile_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="os1-32-nominal"):
        load_profile("os1-64")


def test_modes_out_of_the_list_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"'4096x10': expected one of 512x10, 512x20, 1024x10, 1024x20, 2048x10, 4096x5"
    ):
        load_profile("os1-32-u0", "4096x10")
