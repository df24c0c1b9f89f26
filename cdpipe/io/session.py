"""A recorded session on disk: a folder with one JSON file and chunked arrays, without any truth.

    session.json        format, sensor metadata (Ouster keys), frames, units, provenance
    odometry.npz        odom_T_sensor (S, 4, 4) float64: pose of each revolution at its middle column
    chunks/00000.npz    range_mm (s, R, W) uint32 (0 = no return), reflectivity (s, R, W) uint8,
                        signal (s, R, W) uint16 photons, column_stamps_ns (s, W) int64, column_poses (s, W, 7) float32

R is the number of beams H. A session with two returns of each beam says `"returns": 2` in session.json; there R is 2 H,
and row H + h holds the second return of beam h.
`column_poses` hold `sensor_T_column`: translation (m) and quaternion (x, y, z, w) of each column in the frame of its
revolution, from the session's own odometry. A session is written under a temporary name and renamed when complete.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field, field_validator

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, read_json, read_npz, require_format
from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, require_poses, require_shape, require_shapes
from cdpipe.core.whole_file import hidden_folder
from cdpipe.core.yamlfile import Document, Settings, validate
from cdpipe.sensor.ouster import SensorMetadata, parse_metadata

FORMAT = "tunnelcd-session"
FORMAT_VERSION = 2
CHUNK_SCANS = 64
# Of one file: below the 128 MiB that the reader of npz accepts; bytes of a pixel and of a column of a chunk.
_CHUNK_BYTES, _PIXEL_BYTES, _COLUMN_BYTES = 120 << 20, 7, 36
_CHUNK = {
    "range_mm": ArraySpec("s,R,W", "uint32"),
    "reflectivity": ArraySpec("s,R,W", "uint8"),
    "signal": ArraySpec("s,R,W", "uint16"),
    "column_stamps_ns": ArraySpec("s,W", "int64"),
    "column_poses": ArraySpec("s,W,7", "float32", is_finite=False),  # checked when read, by scan and column
}
# Format 1 had no signal channel.
_CHUNKS = {1: {name: spec for name, spec in _CHUNK.items() if name != "signal"}, FORMAT_VERSION: _CHUNK}
_ODOMETRY = {"odom_T_sensor": ArraySpec("S,4,4", "float64", is_finite=False)}  # checked with the number of the scan


@dataclass(frozen=True, slots=True, eq=False)
class ScanChunk:
    """A run of consecutive revolutions.

    Attributes:
        range_mm: (s, R, W) uint32 staggered ranges, millimetres, 0 where nothing returned.
        reflectivity: (s, R, W) uint8, calibrated; values up to 100 are percent of a perfect diffuse reflector.
        signal: (s, R, W) uint16 photons of the return, the sensor's signal channel; 0 if unknown.
        column_stamps_ns: (s, W) int64 time of each column since the start of the session.
        column_poses: (s, W, 7) float32 `sensor_T_column` as x, y, z, qx, qy, qz, qw.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    column_stamps_ns: Int64Array
    column_poses: Float32Array

    def __post_init__(self) -> None:
        require_shape("range_mm", self.range_mm, (None, None, None))
        shape = s, _, width = self.range_mm.shape
        require_shapes(self, reflectivity=shape, signal=shape, column_stamps_ns=(s, width), column_poses=(s, width, 7))


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """An opened session; its chunks are read on demand.

    Attributes:
        path: Folder of the session.
        sensor: Its sensor.
        odom_T_sensor: (S, 4, 4) float64 pose of each revolution at its middle column, in the session's own odom frame.
        chunk_scans: Revolutions per chunk; the last chunk may hold fewer.
        provenance: How it was made, as stored.
        format_version: Number of the format that its files are in.
        n_returns: Returns of each beam, 1 or 2.
    """

    path: Path
    sensor: SensorMetadata
    odom_T_sensor: Float64Array
    chunk_scans: int
    provenance: dict[str, Any]
    format_version: int = field(default=FORMAT_VERSION, kw_only=True)
    n_returns: int = field(default=1, kw_only=True)

    @property
    def rows(self) -> int:
        """Rows R of a revolution: the beams, then the second return of each where there are two."""
        return self.sensor.height * self.n_returns

    @property
    def n_scans(self) -> int:
        """Number of revolutions S."""
        return len(self.odom_T_sensor)

    @property
    def n_chunks(self) -> int:
        """Number of chunk files."""
        return -(-self.n_scans // self.chunk_scans)

    def chunk(self, index: int) -> ScanChunk:
        """Read one chunk.

        Raises:
            InputError: The file is missing or does not hold what the format promises.
        """
        n_scans = min(self.chunk_scans, self.n_scans - index * self.chunk_scans)
        lengths = {"s": n_scans, "R": self.rows, "W": self.sensor.width}
        arrays = read_npz(chunk_path(self.path, index), _CHUNKS[self.format_version], lengths=lengths)
        if "signal" not in arrays:
            arrays["signal"] = np.zeros(arrays["range_mm"].shape, dtype=np.uint16)
        return ScanChunk(**arrays)

    def chunks(self) -> Iterator[ScanChunk]:
        """Read all chunks in order."""
        return (self.chunk(index) for index in range(self.n_chunks))


class SessionWriter:
    """Writes a session chunk by chunk; `close` gives the folder its name.

    It is a context manager; an exception inside removes the unfinished folder.
    """

    def __init__(
        self, path: Path, sensor: SensorMetadata, chunk_scans: int, provenance: dict[str, Any], n_returns: int = 1
    ) -> None:
        if path.exists():
            raise InputError(f"{path} exists already: name a new folder or remove it")
        self._path = path
        self._partial = path.with_name(f".{path.name}.partial")
        self._held = ExitStack()
        self._sensor = sensor
        self._chunk_scans = chunk_scans
        self._provenance = provenance
        self._n_returns = n_returns
        self._n_chunks = 0

    def __enter__(self) -> SessionWriter:
        with self._writing(), ExitStack() as stack:
            self._partial = stack.enter_context(hidden_folder(self._path))
            (self._partial / "chunks").mkdir()
            self._held = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.close()

    @property
    def folder(self) -> Path:
        """The unfinished folder, for further files of the session (its truth)."""
        return self._partial

    def add(self, chunk: ScanChunk) -> None:
        """Append one chunk; every chunk but the last must hold `chunk_scans` revolutions.

        Raises:
            InputError: It cannot be written, for example because the disk is full.
        """
        arrays = {name: getattr(chunk, name) for name in ScanChunk.__dataclass_fields__}
        with self._writing():
            np.savez(chunk_path(self._partial, self._n_chunks), allow_pickle=False, **arrays)
        self._n_chunks += 1

    def close(self, odom_T_sensor: Float64Array) -> None:
        """Write the (S, 4, 4) poses and session.json, and rename the folder.

        Raises:
            InputError: They cannot be written.
            ValueError: The number of poses does not fit the chunks.
        """
        require_poses("odom_T_sensor", odom_T_sensor)
        if self._n_chunks != -(-len(odom_T_sensor) // self._chunk_scans):
            raise ValueError(f"{self._n_chunks} chunks of {self._chunk_scans} do not hold {len(odom_T_sensor)} poses")
        document = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "n_scans": len(odom_T_sensor),
            "chunk_scans": self._chunk_scans,
            **({"returns": self._n_returns} if self._n_returns > 1 else {}),
            "units": {"range": "mm", "length": "m", "time": "ns", "angle": "rad"},
            "frames": {"odom": "the session's own, x forward, z up", "sensor": "Ouster sensor frame"},
            "sensor": self._sensor.to_json(),
            "provenance": self._provenance,
        }
        with self._writing():
            np.savez(self._partial / "odometry.npz", allow_pickle=False, odom_T_sensor=odom_T_sensor)
            (self._partial / "session.json").write_text(json.dumps(document, indent=1))
            self._partial.replace(self._path)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(f"{self._path}: cannot write there: {error.strerror}") from error


class _Header(Settings):
    """The fields of session.json that readers use."""

    model_config = ConfigDict(extra="ignore", strict=True)

    n_scans: int
    chunk_scans: Annotated[int, Field(ge=1)]
    returns: Literal[1, 2] = 1
    sensor: dict[str, Any]
    provenance: dict[str, Any]

    @field_validator("provenance")
    @classmethod
    def _fits_stamps(cls, provenance: dict[str, Any]) -> dict[str, Any]:
        start_ns = provenance.get("sensor_clock_start_ns", 0)
        if type(start_ns) is not int or not 0 <= start_ns < 2**62:
            raise ValueError(f"sensor_clock_start_ns = {start_ns!r:.40}: expected nanoseconds, 0 to 2^62")
        return provenance


def is_session(path: Path) -> bool:
    """Return whether a folder holds a session.json."""
    return (path / "session.json").is_file()


def read_session(path: Path) -> Session:
    """Open a session folder.

    Raises:
        InputError: The folder or a file is missing, damaged, of another format or version, or a pose is not rigid.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such session folder")
    if not is_session(path):
        raise InputError(f"{path}: no session.json in it: expected a session written by `tunnelcd simulate`")
    source = path / "session.json"
    expected = "expected a session written by `tunnelcd simulate`, copy it again"
    document = read_json(source, expected)
    found = document.get("format"), document.get("format_version")
    remedy = "make it again with `tunnelcd simulate` or `tunnelcd convert`"
    version = require_format(source, found, FORMAT, FORMAT_VERSION, remedy)
    try:
        header = validate(_Header, Document(str(source), document))
    except InputError as error:
        raise InputError(f"{error}: {expected}") from error
    n_scans = header.n_scans
    poses = read_npz(path / "odometry.npz", _ODOMETRY)["odom_T_sensor"]
    if len(poses) != n_scans:
        raise InputError(
            f"{path / 'odometry.npz'}: {len(poses)} poses for {n_scans} scans: one pose for each scan is needed"
        )
    if n_scans == 0:
        raise InputError(f"{path}: the session holds no scan: record it, or convert the recording, again")
    try:
        require_poses("odom_T_sensor", poses)
    except ValueError as error:
        raise InputError(f"{path / 'odometry.npz'}: {error}: correct the pose, or remove the scan") from error
    sensor = parse_metadata(header.sensor, str(source))
    return Session(
        path,
        sensor,
        poses,
        header.chunk_scans,
        header.provenance,
        format_version=version,
        n_returns=header.returns,
    )


def fit_chunk(rows: int, width: int, most: int = CHUNK_SCANS) -> int:
    """Return how many revolutions of (R, W) pixels a chunk holds: `most`, or as many as readers accept in a file."""
    return max(1, min(most, _CHUNK_BYTES // (rows * width * _PIXEL_BYTES + width * _COLUMN_BYTES)))


def chunk_path(folder: Path, index: int) -> Path:
    """Return the path of one chunk file."""
    return folder / "chunks" / f"{index:05d}.npz"
