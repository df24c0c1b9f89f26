from __future__ import annotations

import errno
import tempfile
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.spooled import SpooledArray


@pytest.mark.parametrize("held_bytes", [0, 47, 48, 1 << 20])
def test_rows_come_back_as_appended_from_memory_and_from_the_disk(held_bytes: int) -> None:
    rows = np.arange(12, dtype=np.int32).reshape(4, 3)
    spooled = SpooledArray(np.int32, (3,), held_bytes)
    for part in (rows[:1], rows[:0], rows[1:].astype(np.int64)):
        spooled.append(part)
    found = spooled.finish()
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, rows)
    with pytest.raises(ValueError, match="read-only"):
        found[0] = 0


def test_an_array_without_rows_keeps_its_shape() -> None:
    assert SpooledArray(np.uint8, (3,), held_bytes=0).finish().shape == (0, 3)


def test_the_file_has_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    spooled = SpooledArray(np.float64, held_bytes=0)
    spooled.append(np.zeros(100))
    assert not list(tmp_path.iterdir())
    assert spooled.finish().sum() == 0.0


def test_a_full_disk_is_one_line_that_names_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    spooled = SpooledArray(np.float64, held_bytes=0)

    def fail() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(spooled._file, "flush", fail)
    with pytest.raises(InputError, match=r"No space left on device: .* TMPDIR") as caught:
        spooled.append(np.zeros(100))
    assert tempfile.gettempdir() in str(caught.value)
