"""Archives: what a damaged one provokes is one line, and a full disk stays one."""

import errno
import struct
import zipfile
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.files import opened_zip


@pytest.mark.parametrize(
    ("error", "is_damage"),
    [
        (ValueError("two\nlines"), True),
        (KeyError("a"), True),
        (OSError(errno.EINVAL, "Invalid argument"), True),
        (OSError(errno.ENOSPC, "No space left on device"), False),
        (KeyboardInterrupt(), False),
    ],
)
def test_what_goes_wrong_with_an_open_archive(error: BaseException, is_damage: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", "1")
    with (
        pytest.raises(InputError if is_damage else type(error)) as caught,
        opened_zip(path, path.stat().st_size, "copy it") as (_, members),
    ):
        assert [*members] == ["a"]
        raise error
    if is_damage:
        said = str(caught.value)
        assert said.startswith(f"{path}: ") and said.endswith(": copy it") and "\n" not in said


@pytest.mark.parametrize("kind", ["zip", "comment", "zip64"])
def test_a_directory_of_too_many_members_is_not_parsed(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.core.files.zip_file._MOST_DIRECTORY_BYTES", 4_000)
    members = (struct.pack("<4s6H3L5H2L", b"PK\1\2", *([0] * 9), 1, *([0] * 6)) + b"a") * 100
    n_bytes = len(members)
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 100, 100, n_bytes, 0, int(kind == "comment"))
    if kind == "zip64":
        record = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 100, 100, n_bytes, 0)
        end = record + struct.pack("<4sLQL", b"PK\6\7", 0, n_bytes, 1)
        end += struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    (path := tmp_path / "a.zip").write_bytes(members + end + b"c" * (kind == "comment"))
    monkeypatch.setattr("zipfile.ZipFile", lambda _: pytest.fail("it was parsed"))
    told = r"its directory (takes more than|is not at its end)"
    with pytest.raises(InputError, match=told), opened_zip(path, path.stat().st_size, "copy it"):
        pass
