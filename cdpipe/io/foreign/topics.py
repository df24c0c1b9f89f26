"""Topics that a person names for two bags at once, whose robots may call them differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cdpipe.core.isolated_reader import IsolatedReader
from cdpipe.core.plugins import require_extra
from cdpipe.io.foreign.opening import HowToRead
from cdpipe.io.foreign.sniff import guess_format


def share_topics(paths: Sequence[Path], hows: Sequence[HowToRead]) -> list[HowToRead]:
    """Return how to read recordings, each bag with the topics that it holds.

    What none holds stays named for all, and so does everything for a bag that holds none of it: it is then refused.

    Raises:
        InputError: A bag cannot be read.
    """
    told = list(zip(paths, hows, strict=True))
    bags = {path for path, how in told if how.topics and guess_format(path, how.format) == "bag"}
    if len(bags) < 2:
        return list(hows)
    held = {path: _list_topics(path) for path in bags}
    some = set().union(*held.values())
    of_others = {path: some - own for path, own in held.items()}
    kept = [tuple(name for name in how.topics if name not in of_others.get(path, ())) for path, how in told]
    return [replace(how, topics=names or how.topics) for how, names in zip(hows, kept, strict=True)]


def _list_topics(path: Path) -> set[str]:
    """Return the topics of a bag with a message."""
    require_extra("formats", str(path))
    reader = IsolatedReader("cdpipe.io.foreign.bag_files", path, "rosbags")
    ((about, _),) = reader.read("list_topics", path=str(path))
    return {name for name, _, count in about["topics"] if count}
