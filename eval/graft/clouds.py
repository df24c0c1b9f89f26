"""Scans of bare points as a session: one beam, and one column for each return, which carries the ray's direction.

A recording without a beam table (a bag, PLY, PCD, LAS, KITTI) tells where its returns are and not which beams had none.
Each return is a ray from the sensor's place at the stamp of its scan. A session of one beam whose column poses turn the
column to the return holds these rays: places are exact to the millimetre step of its ranges.

Intensities become the reflectivity of the session, 0 to 255, in a unit that holds for a whole recording. Photons are
not known: the signal is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.session import ScanChunk, Session, fit_chunk
from cdpipe.model.types import PosedScan, ScanSource
from cdpipe.sensor.ouster import BARE_POINTS, SensorMetadata

_MOST_RAYS = 262_144
_CHUNK_SCANS = 16
_BRIGHTEST = 255


@dataclass(frozen=True, slots=True, eq=False)
class CloudSession(Session):
    """A session whose revolutions are scans of bare points; `path` is the name of the recording.

    Attributes:
        source: The recording.
        brightness: Reflectivity of the session for an intensity of 1 of the recording.
    """

    source: ScanSource | None = None
    brightness: float = 1.0

    def chunk(self, index: int) -> ScanChunk:
        """Return one chunk.

        Raises:
            InputError: A scan cannot be read.
        """
        assert self.source is not None
        first = index * self.chunk_scans
        scans = [self.source.scan(number) for number in range(first, min(first + self.chunk_scans, self.n_scans))]
        rows = [_as_columns(scan, self.sensor, self.brightness) for scan in scans]
        range_mm, shone, signal, stamps_ns, poses = (np.stack(each) for each in zip(*rows, strict=True))
        channels = range_mm[:, None].astype(np.uint32), shone[:, None].astype(np.uint8)
        return ScanChunk(*channels, signal[:, None].astype(np.uint16), stamps_ns, poses)


def as_session(source: ScanSource) -> CloudSession:
    """Return the scans of a source as a session; all of them are read once, to find the largest and the brightest.

    Raises:
        InputError: A scan cannot be read, or has more than 262,144 returns.
    """
    width, brightness = _survey(source)
    if width > _MOST_RAYS:
        raise InputError(f"{source.name}: a scan has {width} returns: {_MOST_RAYS} at most can be grafted; thin it")
    sensor = SensorMetadata(BARE_POINTS, "none", f"{width}x10", np.zeros(1), np.zeros(1), 0.0, np.eye(4), (0,))
    chunk_scans = fit_chunk(1, width, _CHUNK_SCANS)
    path, poses = Path(source.name), np.asarray(source.odom_T_sensor)
    return CloudSession(
        path, sensor, poses, chunk_scans, {"recording": path.name}, source=source, brightness=brightness
    )


def _survey(source: ScanSource) -> tuple[int, float]:
    """Return the returns of the largest scan, and the reflectivity that an intensity of 1 becomes.

    Shares of 1 fill the range, as KITTI's do; others up to 255 stay. Larger ones, as 16 bits or photons, are divided
    by the least power of two that brings them there: two recordings of one sensor mostly get the same one.
    """
    width, brightest, has_shares = 0, 0.0, False
    for scan in source.scans():
        width = max(width, len(scan.points_sensor))
        if scan.intensity is not None:
            known = scan.intensity[np.isfinite(scan.intensity)]
            brightest = max(brightest, float(known.max(initial=0.0)))
            has_shares |= bool((known != np.round(known)).any())
    if brightest > _BRIGHTEST:
        return width, float(2.0 ** -np.ceil(np.log2(brightest / (_BRIGHTEST + 1))))
    return width, float(_BRIGHTEST) if has_shares and brightest <= 1.0 else 1.0


def _as_columns(scan: PosedScan, sensor: SensorMetadata, brightness: float) -> tuple[np.ndarray, ...]:
    """Return range, reflectivity, signal, stamp (W,) and pose (W, 7) of each column; those after the last have none."""
    points, n = scan.points_sensor, len(scan.points_sensor)
    range_m = np.linalg.norm(points, axis=1)
    poses = np.zeros((sensor.width, 7))
    poses[:, 6] = 1.0
    poses[:n, 3:] = _turn(sensor.directions[0, :n], points / np.maximum(range_m, 1e-9)[:, None])
    range_mm, shone, signal = (np.zeros(sensor.width) for _ in range(3))
    range_mm[:n] = np.maximum(np.rint(range_m * 1000.0), 1.0)
    if scan.intensity is not None:
        known = np.nan_to_num(scan.intensity.astype(np.float64) * brightness, posinf=_BRIGHTEST)
        shone[:n] = np.clip(np.rint(known), 0, _BRIGHTEST)
    signal[:n] = 0 if scan.signal is None else scan.signal
    stamps_ns = np.full(sensor.width, scan.stamps_ns[-1])
    stamps_ns[:n] = scan.stamps_ns
    return range_mm, shone, signal, stamps_ns, poses.astype(np.float32)


def _turn(start: Float64Array, end: Float64Array) -> Float64Array:
    """Return the quaternions (N, 4), x y z w, of the shortest turns from unit vectors (N, 3) to unit vectors (N, 3)."""
    cosine = (start * end).sum(axis=1, keepdims=True)
    quaternions = np.concatenate([np.cross(start, end), 1.0 + cosine], axis=1)
    is_back = cosine[:, 0] < -1.0 + 1e-9  # half a turn about the vertical, which is square to a level column
    quaternions[is_back] = (0.0, 0.0, 1.0, 0.0)
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
