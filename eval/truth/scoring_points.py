"""Scoring points of a session: one return per 0.1 m cell of its own odom frame, against which objects are scored.

The truth of a change and the answer of a method are both subsets of these rows. An object at close range, with a
hundred returns per cell, therefore weighs as much as a distant one. Cells are fixed in the session's own odometry, so
that a wrong merge acts only through the answer. A mixed return (`sim.session.truth`) is a row only in a cell that holds
no other; such rows are left out of truth and answers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, read_npz
from cdpipe.core.geometry import Float32Array, Int32Array, Int64Array, require_shapes, transform
from cdpipe.core.geometry.voxel import cell_keys, max_coordinate_m
from cdpipe.core.whole_file import whole_file
from cdpipe.io.readers import open_session
from cdpipe.io.session import Session, chunk_path, read_session
from cdpipe.model.types import PosedScan
from sim.session.truth import MIXED, Int16Array, read_labels

CELL_M = 0.1
_CACHE_VERSION = 4
_BATCH_RETURNS = 500_000
_PENDING_ROWS = 4_000_000
_CACHE = {
    "fingerprint": ArraySpec("", "str"),
    "returns": ArraySpec("N", "int64"),
    "points_odom": ArraySpec("N,3", "float32"),
    "change": ArraySpec("N", "int16"),
    "instance": ArraySpec("N", "int16"),
    "nearest_m": ArraySpec("C", "float32", is_finite=False),  # infinite where a change was not seen
}
_Rows = dict[str, npt.NDArray[Any]]  # the columns of `ScoringPoints`, and the cell of each


@dataclass(frozen=True, slots=True, eq=False)
class ScoringPoints:
    """One return per occupied cell, in the order of measurement.

    Attributes:
        returns: (N,) int64 scan * n_pixels + pixel of each, rising.
        points_odom: (N, 3) float32 deskewed points, the session's odom frame, metres.
        change: (N,) int16 id of the change each belongs to, 0 for none, `MIXED` for neither.
        instance: (N,) int16 what each hit: 0 walls and floor, n the n-th prop, -2 nothing (a false return), -3 mist or
            dust, -4 what a puddle or a pane mirrors, -5 glare.
        n_scans: Revolutions of the session.
        n_pixels: Pixels of a revolution.
        nearest_m: (C + 1,) float32 shortest range of any return of each change, by its id; infinite where none is.
    """

    returns: Int64Array
    points_odom: Float32Array
    change: Int16Array
    instance: Int16Array
    n_scans: int
    n_pixels: int
    nearest_m: Float32Array = field(default_factory=lambda: np.zeros(0, dtype=np.float32))

    def __post_init__(self) -> None:
        n = len(self.returns)
        require_shapes(self, points_odom=(n, 3), change=(n,), instance=(n,))

    def __len__(self) -> int:
        return len(self.returns)

    def scans(self, rows: Int64Array) -> Int64Array:
        """Return the scan of each of some rows."""
        return self.returns[rows] // self.n_pixels

    def pixels(self, rows: Int64Array) -> Int64Array:
        """Return the pixel of each of some rows, row * W + column."""
        return self.returns[rows] % self.n_pixels

    def rows_of_change(self, change_id: int) -> Int64Array:
        """Return the rows that belong to a change: the cells of its truth."""
        return np.flatnonzero(self.change == change_id)

    def range_of_change(self, change_id: int) -> float:
        """Return the shortest range at which a change was seen, metres; NaN where it was not."""
        nearest_m = float(self.nearest_m[change_id]) if change_id < len(self.nearest_m) else np.inf
        return nearest_m if np.isfinite(nearest_m) else float("nan")

    def rows_of_returns(self, returns: Int32Array | Int64Array) -> Int64Array:
        """Return the rows, rising, that are among (M, 2) (scan, pixel) returns; the others share a cell with a row."""
        wanted = returns[:, 0].astype(np.int64) * self.n_pixels + returns[:, 1]
        if len(self) == 0:
            return np.zeros(0, dtype=np.int64)
        place = np.minimum(np.searchsorted(self.returns, wanted), len(self) - 1)
        return np.unique(place[self.returns[place] == wanted])


def load_scoring_points(session: Path, *, keeps: bool = True) -> ScoringPoints:
    """Return the scoring points of a simulated session: from `truth/scoring_points.npz`, or built.

    Args:
        session: The session.
        keeps: Whether they are stored there when they are built.

    Raises:
        InputError: The session or its truth is missing or damaged.
    """
    opened = read_session(session)
    path = session / "truth" / "scoring_points.npz"
    fingerprint = _fingerprint(opened)
    cached = _read_cache(path, fingerprint, opened)
    if cached is not None:
        return cached
    scoring_points = build_scoring_points(opened)
    if keeps and not session.is_symlink() and not path.parent.is_symlink():  # else the file would lie in another pair
        _write_cache(path, fingerprint, scoring_points)
    return scoring_points


def build_scoring_points(session: Session) -> ScoringPoints:
    """Return the first return of each 0.1 m cell that is not mixed, or else its first, in the order of measurement.

    Scans come in their order, and the pixels of a scan row by row.

    Reads the session as a stream; memory grows by about 60 bytes per cell.

    Raises:
        InputError: The session or its truth is missing or damaged.
    """
    shape = session.rows, session.sensor.width
    builder = ScoringPointsBuilder(str(session.path), *shape)
    scans = open_session(session.path).scans()
    for index, (instance, change) in enumerate(read_labels(session.path, session.n_chunks)):
        n_scans = min(session.chunk_scans, session.n_scans - index * session.chunk_scans)
        for labels in (instance, change):
            if labels.shape != (n_scans, *shape):
                raise InputError(
                    f"{session.path / 'truth'}: labels of chunk {index} are {labels.shape}, but the chunk holds "
                    f"{n_scans} scans of {shape[0]} x {shape[1]}: truth of another session"
                )
        for scan_instance, scan_change, scan in zip(instance, change, scans, strict=False):
            builder.add(scan, scan_instance, scan_change)
    return builder.finish(session.n_scans)


class ScoringPointsBuilder:
    """Receives the scans of a session in order and keeps the first return of each cell, mixed ones last."""

    def __init__(self, name: str, height: int, width: int) -> None:
        self._name = name
        self._n_pixels = height * width
        self._folded: list[_Rows] = []
        self._pending: list[_Rows] = []
        self._batch: list[_Rows] = []
        self._nearest_m: Float32Array = np.zeros(0, dtype=np.float32)

    def add(self, scan: PosedScan, instance: Int16Array, change: Int16Array) -> None:
        """Take the next scan with its (H, W) labels.

        Raises:
            InputError: A point lies too far out for its cell to be numbered.
        """
        if change.any():
            self._nearest_m = _nearer(self._nearest_m, scan, change)
        points_odom = transform(scan.odom_T_sensor, scan.points_sensor)
        try:
            cells = cell_keys(points_odom, CELL_M)
        except ValueError as error:
            raise InputError(f"{self._name}: scan {scan.index}: {error}") from error
        # neighbours on a row mostly share a cell; only the first of them can be the first of the cell
        is_mixed = change.ravel()[scan.pixels] == MIXED
        is_entered = np.append(True, (cells[1:] != cells[:-1]) | (is_mixed[1:] != is_mixed[:-1]))[: len(cells)]
        pixels = scan.pixels[is_entered]
        self._batch.append(
            {
                "cells": cells[is_entered],
                "returns": scan.index * self._n_pixels + pixels.astype(np.int64),
                "points_odom": points_odom[is_entered].astype(np.float32),
                "change": change.ravel()[pixels],
                "instance": instance.ravel()[pixels],
            }
        )
        if _count(self._batch) < _BATCH_RETURNS:
            return
        self._pending.append(_first_per_cell(self._batch))
        self._batch = []
        # fold once as much is pending as folded: sorting then stays linear in the length of the session
        if _count(self._pending) > max(_PENDING_ROWS, _count(self._folded)):
            self._folded, self._pending = [_first_per_cell([*self._folded, *self._pending])], []

    def finish(self, n_scans: int) -> ScoringPoints:
        """Return the scoring points of the session, which has so many scans."""
        cells = _first_per_cell([*self._folded, *self._pending, *self._batch])
        order = np.argsort(cells["returns"])
        columns = {name: values[order] for name, values in cells.items() if name != "cells"}
        return ScoringPoints(**columns, n_scans=n_scans, n_pixels=self._n_pixels, nearest_m=self._nearest_m)


def _nearer(nearest_m: Float32Array, scan: PosedScan, change: Int16Array) -> Float32Array:
    """Return the shortest ranges by change id, updated with those of one scan."""
    ids = change.ravel()[scan.pixels]
    is_change = ids > 0
    extended = np.full(max(len(nearest_m), int(ids.max(initial=0)) + 1), np.inf, dtype=np.float32)
    extended[: len(nearest_m)] = nearest_m
    range_m = np.linalg.norm(scan.points_sensor[is_change], axis=1)
    np.minimum.at(extended, ids[is_change], range_m)
    return extended


def _count(parts: Sequence[_Rows]) -> int:
    return sum(len(part["cells"]) for part in parts)


def _first_per_cell(parts: Sequence[_Rows]) -> _Rows:
    """Keep the first row of each cell, a mixed one if there is no other; `parts` are in the order of measurement."""
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    mixed_last = np.argsort(rows["change"] == MIXED, kind="stable")
    _, first = np.unique(rows["cells"][mixed_last], return_index=True)
    return {name: values[mixed_last[first]] for name, values in rows.items()}


def _fingerprint(session: Session) -> str:
    """Return a digest that changes with any file that the scoring points depend on."""
    hasher = hashlib.sha256(f"{_CACHE_VERSION} {CELL_M}".encode())
    for name in ("session.json", "odometry.npz"):
        hasher.update((session.path / name).read_bytes())
    for index in range(session.n_chunks):
        for path in (chunk_path(session.path, index), session.path / "truth" / f"{index:05d}.npz"):
            if not path.is_file():
                raise InputError(f"{path}: missing: only whole simulated sessions can be scored")
            status = path.stat()
            hasher.update(f"{path.name} {status.st_size} {status.st_mtime_ns}".encode())
    return hasher.hexdigest()


def _read_cache(path: Path, fingerprint: str, session: Session) -> ScoringPoints | None:
    try:
        arrays = read_npz(path, _CACHE)
        if str(arrays.pop("fingerprint")) != fingerprint:
            return None
        n_pixels = session.rows * session.sensor.width
        returns = arrays["returns"]
        is_within = (returns >= 0) & (returns < session.n_scans * n_pixels)
        if not is_within.all() or (np.diff(returns) <= 0).any():
            return None
        if not (np.abs(arrays["points_odom"]) <= max_coordinate_m(CELL_M)).all():
            return None
        return ScoringPoints(**arrays, n_scans=session.n_scans, n_pixels=n_pixels)
    except (InputError, ValueError):
        return None  # absent or damaged: rebuilt from the session


def _write_cache(path: Path, fingerprint: str, scoring_points: ScoringPoints) -> None:
    arrays = {name: getattr(scoring_points, name) for name in _CACHE if name != "fingerprint"}
    # a read-only folder is scored without the cache, more slowly
    with suppress(OSError), whole_file(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, fingerprint=np.array(fingerprint), **arrays)
