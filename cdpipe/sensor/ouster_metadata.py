"""Parse and check the metadata JSON of an Ouster sensor; an error names file and key on one line.

Two layouts are read: the flat one of early firmware and of `SensorMetadata.to_json`, and the nested one of newer
firmware and of the vendor's SDK.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array

METADATA_FILE = "expected the metadata .json of an Ouster sensor"
MODES = ("512x10", "512x20", "1024x10", "1024x20", "2048x10", "4096x5")

_SECTIONS = ("sensor_info", "config_params", "beam_intrinsics", "lidar_intrinsics", "imu_intrinsics")
# Default distance of the beam origin from the spin axis by product line, as in the vendor's SDK 1.0.1.
_BEAM_ORIGIN_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
_OTHER_BEAM_ORIGIN_MM = 12.163
_FARTHEST_BEAM_ORIGIN_MM = 100.0
_LARGEST_ENTRY = 1e5  # of a transform within a sensor, millimetres
_LIDAR_TO_SENSOR_MM = (-1.0, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1)
# Four times what the largest sensor has; tables of its directions are made before any scan is read.
_MOST_BEAMS, _MOST_COLUMNS = 512, 16_384
# Of one beam: sessions made of bare points have a column for each of them.
_MOST_RAYS = 262_144
_BEAMS_OF_PRODUCT = re.compile(r"^OS-[0-9A-Za-z]+-(\d+)")


def parse_fields(document: Mapping[str, Any], source: str, mode: str | None = None) -> dict[str, Any]:
    """Return the fields of a `SensorMetadata`.

    Args:
        document: The parsed JSON.
        source: Name of the document in messages.
        mode: "<columns>x<Hz>" that replaces the document's mode.

    Raises:
        InputError: A key is missing, or its value is impossible or contradicts another.
    """
    flat = dict(document)
    for section in _SECTIONS:
        if isinstance(document.get(section), dict):
            flat.update(document[section])
    for key in ("beam_altitude_angles", "beam_azimuth_angles", "lidar_mode"):
        if flat.get(key) is None:
            keys = ", ".join(list(document)[:4]) or "nothing"
            raise InputError(
                f"{source}: {key} is missing (there is {keys}): expected the metadata JSON of an Ouster sensor"
            )
    product = str(flat.get("prod_line", "unknown"))
    altitude_deg, azimuth_deg = _beams(flat, source, product)
    own_mode, most = str(flat["lidar_mode"]), _MOST_RAYS if len(altitude_deg) == 1 else _MOST_COLUMNS
    columns, own_columns = _columns(mode or own_mode, source, most), _columns(own_mode, source, most)
    shift = _pixel_shift(document, source, len(altitude_deg), own_columns)
    if shift is None or columns != own_columns:
        shift = np.round((azimuth_deg - azimuth_deg.min()) * columns / 360.0).astype(int).tolist()
    return {
        "product": product,
        "serial": str(flat.get("prod_sn", "unknown")),
        "mode": mode or own_mode,
        "altitude_deg": altitude_deg,
        "azimuth_deg": azimuth_deg,
        "beam_origin_m": _beam_origin_mm(flat, source, product) / 1000.0,
        "sensor_T_lidar": _sensor_T_lidar(flat, source),
        "pixel_shift": tuple(shift),
    }


def require_mode(mode: str, source: str) -> None:
    """Raise `InputError` unless a mode is one of the sensor's."""
    if mode not in MODES:
        raise InputError(f"{source}: lidar_mode = {mode!r}: expected one of {', '.join(MODES)}")


def _numbers(values: Any, source: str, key: str) -> Float64Array:
    """Return a JSON list as (N,) finite numbers."""
    if not isinstance(values, list | tuple):
        raise InputError(f"{source}: {key} must be a list of numbers, got {values!r:.40}")
    numbers = np.array([_number(value, source, f"{key}[{at}]") for at, value in enumerate(values)], dtype=np.float64)
    if not np.isfinite(numbers).all():
        bad = int(np.argmin(np.isfinite(numbers)))
        raise InputError(f"{source}: {key}[{bad}] = {numbers[bad]}: expected a finite number")
    return numbers


def _number(value: Any, source: str, key: str) -> float:
    """Return a JSON number as float; text and booleans are refused."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{source}: {key} must be a number, got {value!r:.40}")
    try:
        return float(value)
    except OverflowError as error:
        raise InputError(f"{source}: {key} is beyond any number a sensor has") from error


def _beams(flat: Mapping[str, Any], source: str, product: str) -> tuple[Float64Array, Float64Array]:
    """Return altitude and azimuth (H,) of every beam, degrees, top beam first."""
    altitude_deg = _numbers(flat["beam_altitude_angles"], source, "beam_altitude_angles")
    azimuth_deg = _numbers(flat["beam_azimuth_angles"], source, "beam_azimuth_angles")
    if len(altitude_deg) != len(azimuth_deg):
        raise InputError(
            f"{source}: beam_altitude_angles and beam_azimuth_angles must be equally long, "
            f"got {len(altitude_deg)} and {len(azimuth_deg)} numbers"
        )
    # first-generation units with 32 beams list 64 and set the absent ones to zero
    is_absent = (altitude_deg == 0.0) & (azimuth_deg == 0.0)
    if len(altitude_deg) == 64 and is_absent.sum() == 32:
        altitude_deg, azimuth_deg = altitude_deg[~is_absent], azimuth_deg[~is_absent]
    named = _BEAMS_OF_PRODUCT.match(product)
    if named is not None and int(named[1]) != len(altitude_deg):
        raise InputError(
            f"{source}: prod_line = {product!r} has {named[1]} beams, but {len(altitude_deg)} beam angles are listed"
        )
    for key, angles_deg, most_deg in (("altitude", altitude_deg, 90.0), ("azimuth", azimuth_deg, 180.0)):
        if np.abs(angles_deg).max(initial=0.0) > most_deg:
            raise InputError(f"{source}: beam_{key}_angles exceed {most_deg:g} deg: expected degrees")
    if len(altitude_deg) > _MOST_BEAMS:
        raise InputError(f"{source}: {len(altitude_deg)} beam angles are listed: a sensor has {_MOST_BEAMS} at most")
    if len(altitude_deg) == 0 or (np.diff(altitude_deg) >= 0).any():
        raise InputError(f"{source}: beam_altitude_angles must fall from the top beam to the bottom one")
    return altitude_deg, azimuth_deg


def _columns(mode: str, source: str, most: int) -> int:
    columns, _, rate = mode.partition("x")
    is_number = all(word.isdecimal() and len(word) < 7 for word in (columns, rate))
    if not is_number or not 0 < int(columns) <= most or int(rate) == 0:
        raise InputError(f"{source}: lidar_mode = {mode!r:.40}: expected <columns>x<Hz>, one of {', '.join(MODES)}")
    return int(columns)


def _pixel_shift(document: Mapping[str, Any], source: str, height: int, columns: int) -> list[int] | None:
    """Return the pixel shift of each row in the document's own mode; None if it is not given."""
    layout = document.get("lidar_data_format") or document.get("data_format") or {}
    if not isinstance(layout, dict):
        raise InputError(f"{source}: data_format must be a JSON object")
    for key, expected in (("pixels_per_column", height), ("columns_per_frame", columns)):
        if layout.get(key, expected) != expected:
            raise InputError(f"{source}: data_format.{key} = {layout[key]!r}, but beams and lidar_mode say {expected}")
    if layout.get("pixel_shift_by_row") is None:
        return None
    shift = _numbers(layout["pixel_shift_by_row"], source, "pixel_shift_by_row")
    if len(shift) != height:
        raise InputError(
            f"{source}: pixel_shift_by_row must hold {height} numbers, one for each beam, got {len(shift)}"
        )
    if np.abs(shift).max(initial=0.0) > _MOST_COLUMNS:
        raise InputError(f"{source}: pixel_shift_by_row exceeds the {_MOST_COLUMNS} columns that a revolution may have")
    return [int(value) for value in shift]


def _beam_origin_mm(flat: Mapping[str, Any], source: str, product: str) -> float:
    """Return the distance of the beam origin from the axis, mm; the SDK's transform takes precedence."""
    key, value = "lidar_origin_to_beam_origin_mm", flat.get("lidar_origin_to_beam_origin_mm")
    if flat.get("beam_to_lidar_transform") is not None:
        key = "beam_to_lidar_transform"
        matrix = _matrix(flat[key], source, key)
        value = matrix[0, 3]
        matrix[0, 3] = 0.0
        if np.abs(matrix - np.eye(4)).max() > 1e-9:
            raise InputError(f"{source}: {key} is more than a shift along x: such a sensor cannot be projected")
    if value is None:
        value = next((mm for line, mm in _BEAM_ORIGIN_MM.items() if product.startswith(line)), _OTHER_BEAM_ORIGIN_MM)
    beam_origin_mm = _number(value, source, key)
    if not 0.0 <= beam_origin_mm <= _FARTHEST_BEAM_ORIGIN_MM:
        raise InputError(
            f"{source}: {key} puts the beam origin {beam_origin_mm:g} mm from the axis: "
            f"expected 0 to {_FARTHEST_BEAM_ORIGIN_MM:g} mm"
        )
    return beam_origin_mm


def _sensor_T_lidar(flat: Mapping[str, Any], source: str) -> Float64Array:
    """Return the (4, 4) pose of the lidar frame in the sensor frame, metres."""
    key = "lidar_to_sensor_transform"
    sensor_T_lidar = _matrix(flat.get(key, _LIDAR_TO_SENSOR_MM), source, key)
    rotation = sensor_T_lidar[:3, :3]
    is_rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6 and np.linalg.det(rotation) > 0
    if not is_rigid or (sensor_T_lidar[3] != (0, 0, 0, 1)).any():
        raise InputError(f"{source}: {key} is not a rigid transform: expected 16 numbers, row by row, millimetres")
    sensor_T_lidar[:3, 3] /= 1000.0
    return sensor_T_lidar


def _matrix(values: Any, source: str, key: str) -> Float64Array:
    numbers = _numbers(values, source, key)
    if len(numbers) != 16:
        raise InputError(f"{source}: {key} must hold 16 numbers, got {len(numbers)}")
    if np.abs(numbers).max() > _LARGEST_ENTRY:
        raise InputError(f"{source}: {key} holds numbers beyond {_LARGEST_ENTRY:g}: expected millimetres")
    return numbers.reshape(4, 4).copy()
