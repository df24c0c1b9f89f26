"""The bytes of a plain file."""

import io
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes


class _TooLarge(io.BytesIO):
    def read(self, size: int | None = -1) -> bytes:
        raise MemoryError


def test_a_file_that_memory_does_not_hold_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"a,b\n")
    assert read_bytes(path) == b"a,b\n"
    monkeypatch.setattr(Path, "open", lambda *_: _TooLarge())
    with pytest.raises(InputError, match=r"^\S*a\.csv: 0\.0 GB, more than there is memory for$"):
        read_bytes(path)


@pytest.mark.parametrize(
    ("n_bytes", "told"), [(1_500, r"2 kB, more than the 1 kB"), (3_000_000, "3 MB, more than the 1 kB")]
)
def test_a_larger_file_is_named_with_its_size(tmp_path: Path, n_bytes: int, told: str) -> None:
    (tmp_path / "a.csv").write_bytes(bytes(n_bytes))
    with pytest.raises(InputError, match=rf"a\.csv: {told} it may have: expected a table$"):
        read_bytes(tmp_path / "a.csv", 1_000, "expected a table")
