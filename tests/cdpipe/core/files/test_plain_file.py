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
    ("n_bytes", "told"),
    [(1_040, "1.0 kB"), (1_500, "1.5 kB"), (999_999, "1.0 MB"), (3_260_000, "3.3 MB"), (23_400_000, "23 MB")],
)
def test_a_larger_file_is_named_with_its_size(tmp_path: Path, n_bytes: int, told: str) -> None:
    (tmp_path / "a.csv").write_bytes(bytes(n_bytes))
    with pytest.raises(InputError, match=rf"a\.csv: {told}, more than the 0\.9 kB it may have: expected a table$"):
        read_bytes(tmp_path / "a.csv", 900, "expected a table")
