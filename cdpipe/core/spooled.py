"""Arrays that are appended to: held in memory while small, then in a temporary file that is mapped into memory."""

from __future__ import annotations

import tempfile
import weakref
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError

_HELD_BYTES = 1 << 27


class SpooledArray:
    """An array that grows by rows, in a temporary file without a name once it exceeds `held_bytes`.

    The file is in the folder for temporary files (`TMPDIR`). It is gone with the array, or with the process.

    Args:
        dtype: Type of the entries.
        row_shape: Shape of one row.
        held_bytes: Bytes that are held in memory.
    """

    def __init__(self, dtype: npt.DTypeLike, row_shape: tuple[int, ...] = (), held_bytes: int = _HELD_BYTES) -> None:
        self._dtype, self._row_shape, self._held_bytes = np.dtype(dtype), row_shape, held_bytes
        self._file: IO[bytes] = tempfile.SpooledTemporaryFile(held_bytes)  # noqa: SIM115 - closed by the next line
        weakref.finalize(self, self._file.close)

    def append(self, rows: npt.NDArray[Any]) -> None:
        """Append (N, *row_shape) rows.

        Raises:
            InputError: The temporary file cannot be written.
        """
        try:
            self._file.write(np.ascontiguousarray(rows, dtype=self._dtype).data)
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"{tempfile.gettempdir()}: cannot write there: {error.strerror}: long sessions need about 22 bytes of "
                "temporary files for each return: make room, or name another folder in the variable TMPDIR"
            ) from error

    def finish(self) -> npt.NDArray[Any]:
        """Return the whole array, read-only; nothing can be appended afterwards."""
        n_bytes = self._file.tell()
        if n_bytes > self._held_bytes:
            flat = np.asarray(np.memmap(self._file, self._dtype, mode="r"))
        else:
            self._file.seek(0)
            flat = np.frombuffer(self._file.read(), self._dtype)
        self._file.close()
        return flat.reshape(-1, *self._row_shape)
