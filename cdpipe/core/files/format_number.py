"""The name and number of a file's format: read, or refused with the command that makes the file anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible


def require_format(path: Path, found: tuple[Any, Any], name: str, version: int, remedy: str, oldest: int = 1) -> int:
    """Check what a file says of its own format.

    Args:
        path: The file, for the message.
        found: Name and number of the format, as the file gives them.
        name: The name expected.
        version: The number that this version writes.
        remedy: What to do about a file of an older format: the command that converts it or makes it anew.
        oldest: The oldest number that this version reads.

    Returns:
        The number found.

    Raises:
        InputError: It is of another name, or of a number that this version does not read.
    """
    is_number = type(found[1]) is int
    if found[0] == name and is_number and oldest <= found[1] <= version:
        return int(found[1])
    read = f"{name} {version}" if oldest == version else f"{name} {oldest} to {version}"
    is_newer = found[0] == name and is_number and found[1] > version
    way = "it is of a newer tunnelcd: update tunnelcd" if is_newer else remedy
    raise InputError(f"{path}: format {_brief(found[0])} {_brief(found[1])}: this version reads {read}: {way}")


def _brief(value: Any) -> str:
    return visible(f"{value!s:.40}") if isinstance(value, str | int | None) else type(value).__name__
