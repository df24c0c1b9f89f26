"""Archives: what a damaged one provokes is one line, and a full disk stays one."""

import errno
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
