"""Public recordings by name: where they are, under which licence, and which of their files are read how."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, Settings, read_yaml, suggest, validate

_FILE = Path(__file__).with_name("recordings.yaml")
UNKNOWN = "unknown"


class Adapter(Settings):
    """A public recording. `sessions` lie below the folder that the user names; without any it cannot be grafted."""

    description: str
    url: str
    licence: str = UNKNOWN
    digest: str = UNKNOWN
    files: tuple[str, ...] = ()  # what is to be fetched
    sessions: tuple[str, ...] = ()
    format: str | None = None
    topics: tuple[str, ...] = ()
    odometry: str | None = None
    unverified: str = ""
    unreadable: str = ""


@cache
def list_adapters() -> dict[str, Adapter]:
    """Return all public recordings by name."""
    document = read_yaml(_FILE)
    return {name: validate(Adapter, Document(f"{_FILE}: {name}", value)) for name, value in document.value.items()}


def locate_recording(name: str, root: Path | None) -> dict[str, Any]:
    """Return how a public recording is read, as keys of `scenarios.grafted.Recording`.

    Args:
        name: Its name.
        root: The folder that holds its files.

    Raises:
        InputError: There is no such recording, it cannot be grafted, or its files are not there.
    """
    known = list_adapters()
    if name not in known:
        hint = suggest(name, known) or f"; known are {', '.join(known)}"
        raise InputError(f"--recording {name}: unknown{hint}")
    adapter = known[name]
    where = f"{adapter.url}, licence: {adapter.licence}"
    if adapter.unreadable:
        raise InputError(f"--recording {name}: {adapter.unreadable} ({where})")
    if root is None:
        raise InputError(
            f"--recording {name}: give --root DIR, the folder that holds {', '.join(adapter.files)} ({where})"
        )
    paths = [root / part for part in adapter.sessions]
    if missing := [str(path) for path in paths if not path.exists()]:
        raise InputError(
            f"--recording {name}: no {', '.join(missing)}: fetch and unpack {', '.join(adapter.files)} ({where})"
        )
    told = {"format": adapter.format, "topics": list(adapter.topics), "odometry": adapter.odometry}
    return {"sessions": [str(root / part) for part in adapter.sessions], **told}
