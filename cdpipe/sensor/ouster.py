"""The Ouster sensor model: metadata, and origin and direction of the ray of every pixel.

Frames and formula follow the vendor's software user manual ("Lidar range to XYZ"). The encoder angle of column m of W
is 2 pi (1 - m / W), so the head spins clockwise seen from above. A beam starts at distance n from the axis, and the
reported range includes n.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json
from cdpipe.core.geometry import Float64Array, require_shapes, transform
from cdpipe.sensor.ouster_metadata import METADATA_FILE, parse_fields, require_mode

BARE_POINTS = "one ray per return"
"""Product of what stands for the unknown sensor of bare points: a beam that column poses turn to each return."""


@dataclass(frozen=True, slots=False, eq=False)
class SensorMetadata:
    """One Ouster sensor in one mode.

    Attributes:
        product: Product line, e.g. "OS-1-32-U0".
        serial: Serial number, or "nominal".
        mode: "<columns>x<Hz>", e.g. "1024x10".
        altitude_deg: (H,) beam altitude, top beam first.
        azimuth_deg: (H,) beam azimuth offset, positive counter-clockwise as Ouster writes it.
        beam_origin_m: Distance of the beam origin from the spin axis, metres.
        sensor_T_lidar: (4, 4) pose of the lidar frame (spin axis) in the sensor frame, metres.
        pixel_shift: (H,) columns by which a row is shifted when a frame is destaggered.
    """

    product: str
    serial: str
    mode: str
    altitude_deg: Float64Array
    azimuth_deg: Float64Array
    beam_origin_m: float
    sensor_T_lidar: Float64Array
    pixel_shift: tuple[int, ...]

    def __post_init__(self) -> None:
        n = len(self.altitude_deg)
        require_shapes(self, altitude_deg=(n,), azimuth_deg=(n,), sensor_T_lidar=(4, 4))

    @property
    def height(self) -> int:
        """Number of beams H."""
        return len(self.altitude_deg)

    @property
    def width(self) -> int:
        """Columns per revolution W."""
        return int(self.mode.split("x")[0])

    @property
    def rate_hz(self) -> float:
        """Revolutions per second."""
        return float(self.mode.split("x")[1])

    @cached_property
    def directions(self) -> Float64Array:
        """(H, W, 3) unit direction of the ray of every staggered pixel, sensor frame."""
        encoder = self._encoder_rad()[None, :]
        azimuth = encoder - np.deg2rad(self.azimuth_deg)[:, None]
        altitude = np.deg2rad(self.altitude_deg)[:, None]
        in_lidar = np.stack(
            [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), np.sin(altitude + 0 * encoder)],
            axis=-1,
        )
        return np.asarray(in_lidar @ self.sensor_T_lidar[:3, :3].T)

    @cached_property
    def origins(self) -> Float64Array:
        """(H, W, 3) origin of the ray of every staggered pixel, sensor frame, metres."""
        encoder = self._encoder_rad()
        ring = np.stack([np.cos(encoder), np.sin(encoder), np.zeros_like(encoder)], axis=-1) * self.beam_origin_m
        in_sensor = transform(self.sensor_T_lidar, ring)
        return np.array(np.broadcast_to(in_sensor, (self.height, self.width, 3)), dtype=np.float64)

    def project(self, ranges_m: Float64Array) -> Float64Array:
        """Return the (..., R, W, 3) points of staggered ranges (..., R, W), sensor frame, metres.

        Each column is in the sensor frame at its own time; deskewing is a separate step. The point of a miss, range 0,
        is undefined. R is H, or 2 H where the second returns of all beams follow the first ones.

        Raises:
            ValueError: The last two axes are not (H, W) or (2 H, W).
        """
        rows = ranges_m.shape[-2] if ranges_m.ndim > 1 else 0
        if rows not in (self.height, 2 * self.height) or ranges_m.shape[-1] != self.width:
            raise ValueError(
                f"ranges_m must be (..., {self.height} or {2 * self.height}, {self.width}), got {ranges_m.shape}"
            )
        if rows != self.height:
            return np.concatenate([self.project(part) for part in np.split(ranges_m, 2, axis=-2)], axis=-3)
        points = np.asarray((ranges_m[..., None] - self.beam_origin_m) * self.directions, dtype=np.float64)
        points += self.origins
        return points

    def column_offsets_ns(self) -> Float64Array:
        """Return the (W,) time of each column after the start of its revolution, nanoseconds."""
        return np.arange(self.width, dtype=np.float64) * (1e9 / self.rate_hz / self.width)

    def to_json(self) -> dict[str, Any]:
        """Return the metadata in Ouster's flat JSON layout."""
        transform_mm = self.sensor_T_lidar.copy()
        transform_mm[:3, 3] *= 1000.0
        return {
            "prod_line": self.product,
            "prod_sn": self.serial,
            "lidar_mode": self.mode,
            "beam_altitude_angles": self.altitude_deg.tolist(),
            "beam_azimuth_angles": self.azimuth_deg.tolist(),
            "lidar_origin_to_beam_origin_mm": self.beam_origin_m * 1000.0,
            "lidar_to_sensor_transform": transform_mm.ravel().tolist(),
            "data_format": {
                "columns_per_frame": self.width,
                "pixels_per_column": self.height,
                "pixel_shift_by_row": list(self.pixel_shift),
            },
        }

    def _encoder_rad(self) -> Float64Array:
        return 2.0 * np.pi * (1.0 - np.arange(self.width) / self.width)


def profile_names() -> list[str]:
    """Return the names of the sensor profiles that ship with the package."""
    return sorted(entry.name.removesuffix(".json") for entry in _profiles().iterdir() if entry.name.endswith(".json"))


def describe_profile(name: str) -> str:
    """Return where the numbers of a shipped profile come from, in words; "" if it does not say."""
    return str(json.loads((_profiles() / f"{name}.json").read_text()).get("_source", ""))


def load_profile(name_or_path: str, mode: str | None = None) -> SensorMetadata:
    """Read a shipped profile by name, or any Ouster metadata JSON by path.

    Args:
        name_or_path: One of `profile_names()`, or the path of a `.json` file.
        mode: "<columns>x<Hz>" that replaces the file's mode.

    Raises:
        InputError: The profile is unknown, the file is no complete Ouster metadata, or the mode is not in `MODES`.
    """
    if name_or_path.endswith(".json"):
        document = read_json(Path(name_or_path), METADATA_FILE)
    elif name_or_path in profile_names():
        document = json.loads((_profiles() / f"{name_or_path}.json").read_text())
    else:
        raise InputError(
            f"sensor profile {name_or_path!r} is unknown: name one of {', '.join(profile_names())}, "
            "or the path of an Ouster metadata .json"
        )
    sensor = parse_metadata(document, name_or_path, mode)
    require_mode(sensor.mode, name_or_path)
    return sensor


def parse_metadata(document: Mapping[str, Any], source: str, mode: str | None = None) -> SensorMetadata:
    """Build the sensor model from parsed metadata, in the flat or the nested layout of newer firmware.

    Any number of columns and any rate are accepted; `load_profile` accepts only the sensor's modes.

    Raises:
        InputError: A key is missing or the beams are inconsistent; the text names `source` and the key.
    """
    if not isinstance(document, dict):
        raise InputError(f"{source}: Ouster metadata must be a JSON object")
    return SensorMetadata(**parse_fields(document, source, mode))


def _profiles() -> Traversable:
    return resources.files("cdpipe") / "sensor" / "profiles"
