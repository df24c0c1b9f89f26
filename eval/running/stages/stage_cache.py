"""Results of the stages of a pair, kept by content: in memory, and in the run folder for a later process.

RUN/stages/<world>/<seed>/<root>/<stage>-<digest>.npz holds the arrays and the seconds of one stage. The root is the
digest of both sessions' files and of the pipeline's code, the name that of everything that the stage reads
(stage_results.py): a result that is found equals the one that would be computed. A file appears whole or
not at all; a damaged one is ignored.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import cdpipe
from cdpipe.core.errors import InputError
from cdpipe.core.files import ArrayType, read_npz, require_plain_file
from cdpipe.core.whole_file import whole_file
from eval.core.provenance import digest, digest_file

MAPS = "maps"
# Maps are large: at most this much of them is stored in a run folder.
MAPS_BYTES = 4 << 30
_FORMAT = 1  # rises when stage_results.py makes something else of the same result
_MOST_BYTES = 2 << 30  # of a file of a session; of a chunk, 120 MB are written
_SECONDS, _IS_CONTENDED, _N_ARRAYS = "seconds.", "is_contended", "n_arrays"
# Deflating noise takes as long as computing it, and saves nothing.
_NOISE = ".return_offsets"
Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """The result of a stage.

    Attributes:
        arrays: Its result, by name.
        seconds: Wall-clock seconds of its parts, as measured when it ran.
        is_contended: Whether workers shared the machine then.
    """

    arrays: Arrays
    seconds: Mapping[str, float] = field(default_factory=dict)
    is_contended: bool = False


class StageCache:
    """Results of the stages of one pair, by name; maps are not held in memory, only stored.

    Args:
        folder: Where; without it nothing is stored.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._held: dict[str, Kept] = {}

    def find(self, name: str) -> Kept | None:
        """Return the result of a name; None where there is none or it is damaged."""
        if name in self._held or self._folder is None:
            return self._held.get(name)
        kept = _read(self._folder / f"{name}.npz")
        if kept is not None and not _is_maps(name):
            self._held[name] = kept
        return kept

    def keep(self, name: str, kept: Kept) -> None:
        """Keep a result; one that cannot be written is computed again by the next process."""
        if not _is_maps(name):
            self._held[name] = kept
        if self._folder is None or (_is_maps(name) and _maps_bytes(self._folder) >= MAPS_BYTES):
            return
        with suppress(OSError), whole_file(self._folder / f"{name}.npz") as partial:
            _write(partial, kept)


def open_cache(folder: Path, sessions: tuple[Path, Path]) -> StageCache:
    """Open the cache of a pair, and remove results of other sessions or other code.

    Args:
        folder: RUN/stages/<world>/<seed>.
        sessions: Folders of both sessions.
    """
    root = digest([_FORMAT, CODE, *(session_digest(session) for session in sessions)])
    for path in folder.glob("*/*"):
        if path.parent.name != root:
            path.unlink()
    return StageCache(folder / root)


def session_digest(session: Path) -> str:
    """Return the digest of the files of a session that the pipeline may read: all but its truth.

    Raises:
        InputError: One is far larger than any of ours; a file without content may be of any size.
    """
    files = [path for path in session.rglob("*") if path.is_file() and path.relative_to(session).parts[0] != "truth"]
    for path in files:
        require_plain_file(path, _MOST_BYTES, "expected a file of a session: remove the pair")
    return files_digest(session, files)


def files_digest(folder: Path, paths: Iterable[Path]) -> str:
    """Return the digest of the names and contents of files below a folder."""
    found = {}
    for path in paths:
        found[path.relative_to(folder).as_posix()] = digest_file(path)
    return digest(found)


# Read when the process starts: later the files may be newer than the loaded code.
CODE = files_digest(Path(cdpipe.__path__[0]), Path(cdpipe.__path__[0]).rglob("*.py"))


def _write(path: Path, kept: Kept) -> None:
    arrays = {
        **{f"{_SECONDS}{name}": np.asarray(seconds) for name, seconds in kept.seconds.items()},
        _IS_CONTENDED: np.asarray(kept.is_contended),
        _N_ARRAYS: np.asarray(len(kept.arrays)),
        **kept.arrays,
    }
    noise = [name for name in arrays if name.endswith(_NOISE)]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        _add(file, {name: array for name, array in arrays.items() if name not in noise})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_STORED) as file:
        _add(file, {name: arrays[name] for name in noise})


def _add(file: zipfile.ZipFile, arrays: Arrays) -> None:
    for name, array in arrays.items():
        with file.open(f"{name}.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array(member, array, allow_pickle=False)


def _read(path: Path) -> Kept | None:
    try:
        arrays = read_npz(path, _check)
    except InputError:
        return None
    is_contended, n_arrays = bool(arrays.pop(_IS_CONTENDED)), float(arrays.pop(_N_ARRAYS))
    seconds = {name: arrays.pop(name) for name in list(arrays) if name.startswith(_SECONDS)}
    told = {name.removeprefix(_SECONDS): float(number) for name, number in seconds.items()}
    return Kept(arrays, told, is_contended) if len(arrays) == n_arrays else None


def _check(types: Mapping[str, ArrayType]) -> None:
    """Raise ValueError unless the numbers beside the result are there; its arrays are those of its stage."""
    for name in (_IS_CONTENDED, _N_ARRAYS, *(name for name in types if name.startswith(_SECONDS))):
        if name not in types or types[name].shape or types[name].dtype.kind not in "biuf":
            raise ValueError(f"{name} must be one number")


def _is_maps(name: str) -> bool:
    return name.startswith(f"{MAPS}-")


def _maps_bytes(folder: Path) -> int:
    """Return how many bytes the maps of all pairs beside one take, counted up to `MAPS_BYTES`.

    Another process may remove some meanwhile.
    """
    total = 0
    for place, _, names in os.walk(folder.parents[2]):
        for name in filter(_is_maps, names):
            with suppress(FileNotFoundError):
                total += Path(place, name).stat().st_size
        if total >= MAPS_BYTES:
            break  # else every pair of thousands would look at the folders of all
    return total
