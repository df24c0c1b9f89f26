"""A sample of the returns of a session as coloured points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float32Array, Float64Array
from cdpipe.io.session import ScanChunk, Session
from sim.sensor.air import AIR
from sim.sensor.glare import GLARE
from sim.sensor.optics import MIRRORED
from sim.session.truth import read_chunk_labels, read_labels

Rgb = tuple[int, int, int]
MAX_POINTS = 300_000
_FAR_M = 10_000.0
_ROCK_RGB = (150, 150, 150)
_AIR_RGB = (140, 200, 240)  # returns of mist and dust, of what water and glass mirror, and of glare
_NOT_THERE = (AIR, MIRRORED, GLARE)
# after Okabe and Ito, which the colour-blind can tell apart
CHANGE_RGB: dict[str, Rgb] = {
    "added": (0, 158, 115),
    "removed": (213, 94, 0),
    "moved": (86, 130, 233),
    "reshaped": (204, 121, 167),
}
SESSION_RGB: dict[str, Rgb] = {"before": (230, 159, 0), "after": (0, 114, 178)}


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of one session.

    Attributes:
        name: Name in the view.
        points: (N, 3) float32, metres.
        colours: (N, 3) uint8 for each quantity, e.g. "change"; the first one is shown first.
        size_m: Edge of a point, metres.
        is_shown: Whether the points are visible at the start, in a view without walls.
    """

    name: str
    points: Float32Array
    colours: Mapping[str, npt.NDArray[np.uint8]]
    size_m: float = 0.025
    is_shown: bool = True


def session_cloud(
    name: str,
    session: Session,
    frame_T_sensor: Float64Array,
    kinds: Mapping[int, str] | None,
    max_points: int = MAX_POINTS,
) -> Cloud:
    """Return about `max_points` of a session's returns, taken evenly from all its revolutions.

    Args:
        name: "group/session".
        session: The session.
        frame_T_sensor: (S, 4, 4) pose of each revolution; the points come in its frame.
        kinds: Kind of each change by id, for colours by truth; None: the truth is not read.
        max_points: Largest number of points.

    Raises:
        InputError: A chunk, or its truth, is missing or damaged.
    """
    stride = max(1, -(-session.n_scans * session.rows * session.sensor.width // max_points))
    labels = None if kinds is None else read_labels(session.path, session.n_chunks)
    points, instances, changes = [], [], []
    for number, chunk in enumerate(session.chunks()):
        first = number * session.chunk_scans
        placed = _place_returns(session, chunk, frame_T_sensor[first : first + len(chunk.range_mm)])
        picked = np.flatnonzero(chunk.range_mm.ravel() > 0)[number % stride :: stride]
        points.append(placed.reshape(-1, 3)[picked])
        if labels is not None:
            instance, change = next(labels)
            instances.append(instance.ravel()[picked])
            changes.append(change.ravel()[picked])
    cloud = np.concatenate(points).astype(np.float32)
    own = SESSION_RGB.get(name.rsplit("/", maxsplit=1)[-1], _ROCK_RGB)
    by_height = _by_height(cloud)
    if kinds is None:
        return Cloud(name, cloud, {"height": by_height})
    change, instance = np.concatenate(changes), np.concatenate(instances)
    by_change = _by_change(change, instance, kinds)
    colours = {
        "change": by_change,
        "instance": _by_instance(instance.astype(np.int64)),
        "session": np.tile(np.array(own, np.uint8), (len(cloud), 1)),
        "height": by_height,
    }
    return Cloud(name, cloud, colours)


def move_near(poses: Float64Array) -> tuple[Float64Array, Float64Array, tuple[str, ...]]:
    """Return poses (S, 4, 4) less a place, that place (3,), and a note about it.

    The place is the middle of the path, rounded to kilometres, where it lies beyond 10 km: there the steps of the
    float32 numbers of a view are 1 mm, in the coordinates of a map grid half a metre. Nearer it is 0, without a note.
    """
    place = np.round(poses[len(poses) // 2, :3, 3], -3)
    if np.abs(place).max() <= _FAR_M:
        return poses, np.zeros(3), ()
    near = poses.copy()
    near[:, :3, 3] -= place
    return near, place, (f"shown about {', '.join(f'{metres + 0.0:.0f}' for metres in place)} m",)


def points_cloud(name: str, points: Float64Array) -> Cloud:
    """Return points (N, 3) as a cloud that is coloured by height."""
    cloud = points.astype(np.float32)
    return Cloud(name, cloud, {"height": _by_height(cloud)})


class Revolutions:
    """The returns of a session, one revolution at a time: the first ones, and the second ones where it has two."""

    def __init__(
        self, name: str, session: Session, frame_T_sensor: Float64Array, kinds: Mapping[int, str] | None
    ) -> None:
        """Take what `session_cloud` takes; nothing is read yet."""
        self._name, self._session, self._poses, self._kinds = name, session, frame_T_sensor, kinds

    def at(self, share: float) -> tuple[Cloud, ...]:
        """Return the returns at a share of the drive.

        Raises:
            InputError: A chunk, or its truth, is missing or damaged.
        """
        session = self._session
        scan = min(int(share * session.n_scans), session.n_scans - 1)
        number, row = divmod(scan, session.chunk_scans)
        chunk, labels = _read_chunk(session, number, has_truth=self._kinds is not None)
        one = ScanChunk(*(getattr(chunk, each.name)[row : row + 1] for each in fields(ScanChunk)))
        placed = _place_returns(session, one, self._poses[scan : scan + 1])[0].reshape(session.n_returns, -1, 3)
        is_hit = one.range_mm.reshape(session.n_returns, -1) > 0
        clouds = []
        for order, (points, hit) in enumerate(zip(placed, is_hit, strict=True)):
            name = f"{self._name} second" if order else self._name
            colours = _by_height(points[hit].astype(np.float32))
            if labels is not None and self._kinds is not None:
                instance, change = (part[row].reshape(session.n_returns, -1)[order][hit] for part in labels)
                colours = _by_change(change, instance, self._kinds)
            clouds.append(Cloud(name, points[hit].astype(np.float32), {"change": colours}, 0.05))
        return tuple(clouds)


@lru_cache(maxsize=4)
def _read_chunk(
    session: Session, number: int, *, has_truth: bool
) -> tuple[ScanChunk, tuple[npt.NDArray[np.int16], npt.NDArray[np.int16]] | None]:
    """Return a chunk of a session, and its labels (s, R, W)."""
    return session.chunk(number), read_chunk_labels(session.path, number) if has_truth else None


def _by_change(
    change: npt.NDArray[np.int16], instance: npt.NDArray[np.int16], kinds: Mapping[int, str]
) -> npt.NDArray[np.uint8]:
    """Colour the rock grey, changes by their kind, and what comes by way of air or water blue."""
    colours = np.tile(np.array(_ROCK_RGB, np.uint8), (len(change), 1))
    colours[np.isin(instance, _NOT_THERE)] = _AIR_RGB
    for number, kind in kinds.items():
        colours[change == number] = CHANGE_RGB[kind]
    return colours


def _place_returns(session: Session, chunk: ScanChunk, frame_T_sensor: Float64Array) -> Float64Array:
    """Return the points (s, H, W, 3) of a chunk's pixels, each column at its own pose."""
    poses = chunk.column_poses.astype(np.float64)
    turns = Rotation.from_quat(poses[..., 3:].reshape(-1, 4)).as_matrix().reshape(*poses.shape[:2], 3, 3)
    placed = np.empty((*chunk.range_mm.shape, 3))
    for scan, frame_T_here in enumerate(frame_T_sensor):
        column = session.sensor.project(chunk.range_mm[scan] / 1000.0)
        sensor = np.einsum("wij,hwj->hwi", turns[scan], column) + poses[scan, :, :3]
        placed[scan] = sensor @ frame_T_here[:3, :3].T + frame_T_here[:3, 3]
    return placed


def _by_instance(instance: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Colour the walls grey, the air blue and each prop by its number, neighbours apart by the golden angle."""
    hue = 2 * np.pi * np.modf(instance * 0.618034)[0]
    wheel = 140 + 100 * np.cos(hue[:, None] + np.array([0.0, 2.1, 4.2]))
    colours = np.where((instance > 0)[:, None], wheel, _ROCK_RGB)
    return np.where(np.isin(instance, _NOT_THERE)[:, None], _AIR_RGB, colours).astype(np.uint8)


def _by_height(points: Float32Array) -> npt.NDArray[np.uint8]:
    """Colour from blue (low) over green to yellow (high)."""
    low, high = np.percentile(points[:, 2], (2, 98)) if len(points) else (0.0, 1.0)
    share = np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)
    stops = np.array([(68, 60, 150), (50, 130, 140), (90, 190, 100), (250, 220, 50)], dtype=np.float64)
    at = np.linspace(0.0, 1.0, len(stops))
    return np.column_stack([np.interp(share, at, stops[:, axis]) for axis in range(3)]).astype(np.uint8)
