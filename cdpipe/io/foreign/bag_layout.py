"""What rosbags opens: files of ROS 1, or a folder with a metadata.yaml it knows, made where a bag has none.

It is called in a process of its own (`cdpipe.core.isolated_reader`).
"""

# ruff: noqa: PLC0415 - rosbags is an extra, and it is imported in the process that reads

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from cdpipe.core.errors import InputError
from cdpipe.core.files import require_plain_file
from cdpipe.core.names import ADDRESS_MARKS

_MCAP, _SQLITE = b"\x89MCAP", b"SQLite format 3"
METADATA, _ABOUT = "metadata.yaml", "rosbag2_bagfile_information"
# Version 9, since ROS 2 Jazzy, has the QoS of a topic as a list, which was a text: nothing here reads it.
_KNOWN_VERSION = 8
# Parts of `rosbag record --split`: run_0.bag or run_2024-05-31-12-30-59_0.bag, the next one without a pause.
_PART = re.compile(r"(.*?)_?(?:\d{4}(?:-\d\d){5})?_(\d{1,9})")
_LONGEST_PAUSE_S = 5.0


def find_paths(path: Path, folder: Path) -> list[Path]:
    """Return what rosbags opens: files of ROS 1, or a folder with metadata.yaml, made in `folder` for a lone file.

    Raises:
        InputError: A file is no plain one, or an MCAP of ROS 1 messages.
        ValueError: It is no bag, or a folder of several.
    """
    if path.is_dir():
        for each in path.iterdir():
            if not each.is_dir():
                require_plain_file(each)
        if (path / METADATA).is_file():
            return [_renew_metadata(path, folder)]
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".bag"))
        if len(files) > 1 and all(file.suffix == ".bag" for file in files):
            return _sort_parts(files)
        if len(files) != 1:
            ways = "write it by `ros2 bag reindex FOLDER`, or name one of them"
            raise ValueError(f"{len(files)} files without a {METADATA}: {ways}")
        path = files[0]
    require_plain_file(path)
    with path.open("rb") as file:
        head = file.read(32)
    if head.startswith(b"#ROSBAG"):
        return [path]
    if not head.startswith((_MCAP, _SQLITE)):
        raise ValueError(
            f"it begins with none of {b'#ROSBAG'!r}, {_MCAP!r} and {_SQLITE!r}: cut short or no bag: copy or record it "
            "again"
        )
    if head.startswith(_MCAP) and head[17:25] == b"\x04\0\0\0ros1":  # its profile
        raise InputError(f"{path}: an MCAP of ROS 1 messages, which is not read: give the .bag that it was made of")
    _make_folder(path, folder, is_mcap=head.startswith(_MCAP))
    return [folder]


def require_one_recording(readers: Sequence[Any]) -> None:
    """Raise `ValueError` unless each ROS 1 bag goes on where the one before it ends."""
    filled = [each for each in readers if each.message_count] if len(readers) > 1 else []
    for before, after in pairwise(filled):
        pause_s = (after.start_time - before.end_time) / 1e9
        if abs(pause_s) > _LONGEST_PAUSE_S:
            raise ValueError(
                f"{after.path.name} begins {pause_s:.1f} s after the end of {before.path.name}: expected parts of one "
                "recording (rosbag record --split): name one of them"
            )


def read_packed(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the metadata of a file-compressed ROS 2 bag as those of its decompressed files, and its packed files.

    Of another bag there are no packed files.
    """
    about = _read_metadata(path)
    if str(about.get("compression_mode")).lower() != "file" or about.get("compression_format") != "zstd":
        return {}, []
    names = _list_files(path, about)
    unpacked = {"compression_mode": "", "compression_format": "", "relative_file_paths": [Path(n).stem for n in names]}
    return {_ABOUT: {**about, **unpacked}}, names


def list_packed_topics(path: Path) -> list[list[Any]]:
    """Return name, type and number of messages of the topics of a file-compressed ROS 2 bag; of another bag none."""
    if not (path / METADATA).is_file():
        return []
    about, names = read_packed(path)
    listed = about[_ABOUT]["topics_with_message_count"] if names else []
    told = [(each["topic_metadata"], each["message_count"]) for each in listed]
    return [[str(topic["name"]), str(topic["type"]), int(count)] for topic, count in told]


def _sort_parts(files: Sequence[Path]) -> list[Path]:
    """Return ROS 1 bags in the order of their numbers, which name parts of one recording."""
    found = [match for file in files if (match := _PART.fullmatch(file.stem))]
    parts = sorted((int(match[2]), file) for match, file in zip(found, files, strict=False))
    numbers = [number for number, _ in parts]
    is_one = len(found) == len(files) and len({match[1] for match in found}) == 1
    if not is_one or numbers != list(range(numbers[0], numbers[0] + len(files))):
        raise ValueError(
            f"{len(files)} bags: expected the parts of one recording, run_0.bag, run_1.bag and so on: name one of them"
        )
    return [file for _, file in parts]


def _renew_metadata(path: Path, folder: Path) -> Path:
    """Return the folder of a bag, or one with links to its files where rosbags would not read these.

    Its metadata may be newer than rosbags knows. Or a path holds marks of an address: rosbags asks SQLite for
    `file:PATH?immutable=1`, which is another file then, opened for writing; and a journal that lies beside such a file
    can name any file for SQLite to delete.
    """
    about = _read_metadata(path)
    version = about.get("version")
    is_newer = isinstance(version, int) and version > _KNOWN_VERSION
    if not is_newer and not ADDRESS_MARKS.search(f"{path.absolute()} {about.get('relative_file_paths')}"):
        return path
    links = [_link(path / name, folder, number) for number, name in enumerate(_list_files(path, about))]
    if is_newer:
        for each in about["topics_with_message_count"]:
            each["topic_metadata"]["offered_qos_profiles"] = ""
        about["version"] = _KNOWN_VERSION
    _write_metadata(folder, {**about, "relative_file_paths": links})
    return folder


def _link(file: Path, folder: Path, number: int = 0) -> str:
    """Link a file of a bag into a folder, and return the link's name: a number, and the suffix if it is plain."""
    name = f"part_{number}{file.suffix if file.suffix[1:].isalnum() else ''}"
    (folder / name).symlink_to(file.absolute())
    return name


def _read_metadata(path: Path) -> dict[str, Any]:
    """Return what metadata.yaml of a bag's folder says; nothing where it says nothing about a bag."""
    from ruamel.yaml import YAML

    document = YAML(typ="safe").load((path / METADATA).read_text(encoding="utf-8"))
    about = document.get(_ABOUT) if isinstance(document, dict) else None
    return about if isinstance(about, dict) else {}


def _list_files(path: Path, about: dict[str, Any]) -> list[str]:
    """Return the names of a bag's files; older versions of the metadata have folders before them."""
    names = [Path(str(each)).name for each in about["relative_file_paths"]]
    missing = [name for name in names if not (path / name).is_file()]
    if missing or not names:
        raise ValueError(f"{METADATA} names {missing[:1] or 'no file'}, which is not in the folder: copy it again")
    return names


def _make_folder(path: Path, folder: Path, *, is_mcap: bool) -> None:
    """Link a lone file of ROS 2 into a folder, with the metadata that lack."""
    name = _link(path, folder)
    topics = _topics_of_mcap(path) if is_mcap else _topics_of_sqlite(path)
    about = {
        "version": 5,
        "storage_identifier": "mcap" if is_mcap else "sqlite3",
        "relative_file_paths": [name],
        "duration": {"nanoseconds": 0},
        "starting_time": {"nanoseconds_since_epoch": 0},
        "message_count": sum(count for *_, count in topics),
        "compression_format": "",
        "compression_mode": "",
        "topics_with_message_count": [
            {"topic_metadata": {"name": name, "type": kind, "serialization_format": form, "offered_qos_profiles": ""},
             "message_count": count}
            for name, kind, form, count in topics
        ],
    }  # fmt: skip
    _write_metadata(folder, about)


def _write_metadata(folder: Path, about: dict[str, Any]) -> None:
    # a link of this name would lead to a file of the user
    with (folder / METADATA).open("x", encoding="utf-8") as file:
        file.write(json.dumps({_ABOUT: about}))  # JSON is YAML


class _Channel(NamedTuple):
    """What rosbags asks of a connection, and the number of the channel."""

    topic: str
    msgtype: str
    key: int


def _topics_of_mcap(path: Path) -> list[tuple[str, str, str, int]]:
    from rosbags.rosbag2.storage_mcap import MCAPFile

    file = MCAPFile(path)
    file.open()
    try:
        if not file.channels:
            file.meta_scan()
        counts: Counter[int] = Counter()
        for chunk in file.chunks:
            counts.update(chunk.channel_count)
        if not file.chunks:  # nor an index: every message is looked at
            asked = [_Channel(each.topic, each.schema, key) for key, each in file.channels.items()]
            counts.update(each.key for each, *_ in file.messages_scan(asked))
        return [(it.topic, it.schema, it.message_encoding, counts.get(it.id, 0)) for it in file.channels.values()]
    finally:
        file.close()


def _topics_of_sqlite(path: Path) -> list[tuple[str, str, str, int]]:
    import sqlite3
    from contextlib import closing
    from urllib.parse import quote

    with closing(sqlite3.connect(f"file:{quote(str(path.absolute()))}?immutable=1", uri=True)) as base:
        counts = dict(base.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall())
        rows = base.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    return [(str(name), str(kind), str(form), int(counts.get(key, 0))) for key, name, kind, form in rows]
