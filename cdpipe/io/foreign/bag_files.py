"""Calls of rosbags on foreign bags; they run in a process of their own (`cdpipe.core.isolated_reader`).

ROS 1 bags, ROS 2 bags (a folder with metadata.yaml, or one .db3) and MCAP. No ROS is needed.
"""

# ruff: noqa: PLC0415 - rosbags is an extra, and it is imported in the process that reads

from __future__ import annotations

import json
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.files import require_plain_file
from cdpipe.core.isolated_reader import Message
from cdpipe.io.foreign.clouds import INTENSITY_FIELDS, TIME_FIELDS, field_of

CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_OLD_TRANSFORMS = "tf/msg/tfMessage"
# Numbers of sensor_msgs/PointField.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_POINTS = 10_000_000
_MOST_POSES = 2_000_000
_MOST_TOPICS = 10_000
_MOST_FRAMES = 8
_STAMPS_AT_ONCE = 50  # 5 s of a recording
_ERRORS = (
    OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, AssertionError,
    UnicodeError, EOFError,
)  # fmt: skip


def list_topics(path: str) -> Iterator[Message]:
    """Yield one dict: `topics`, for each its name, type and number of messages."""
    with _bag(path) as bag:
        if len(bag.connections) > _MOST_TOPICS:
            raise ValueError(f"{len(bag.connections)} topics")
        counts: dict[tuple[str, str], int] = {}
        for each in bag.connections:
            key = (str(each.topic), str(each.msgtype).replace(_OLD_TRANSFORMS, TRANSFORMS))
            counts[key] = counts.get(key, 0) + int(each.msgcount)
        topics = [[name, kind, count] for (name, kind), count in counts.items()]
    yield {"topics": topics}, {}


def read_stamps(path: str, topic: str) -> Iterator[Message]:
    """Yield the stamps (S,) int64 ns of a cloud topic's headers, whether each has returns, and their frames, sorted.

    They come `_STAMPS_AT_ONCE` clouds at a time, as every cloud of a long recording is read for them.
    """
    with _bag(path) as bag:
        messages = (message for message, _ in _messages(bag, [topic]))
        while clouds := [_head(message) for message in islice(messages, _STAMPS_AT_ONCE)]:
            frames, stamps, has_returns = zip(*clouds, strict=True)
            about = {"frames": sorted(set(frames) - {""})[:_MOST_FRAMES]}
            yield about, {"stamps": np.array(stamps, np.int64), "has_returns": np.array(has_returns, np.uint8)}


def _head(message: Any) -> tuple[str, int, bool]:
    """Return the frame and the stamp of a cloud, and whether it has returns."""
    points = _cloud(message)["points"]
    has_returns = bool((np.isfinite(points).all(axis=1) & points.any(axis=1)).any())
    return str(message.header.frame_id).lstrip("/"), _nanoseconds(message.header.stamp), has_returns


def read_clouds(path: str, topic: str) -> Iterator[Message]:
    """Yield each cloud of a topic: its points (N, 3), and the times (N,) where there are some."""
    with _bag(path) as bag:
        for message, _ in _messages(bag, [topic]):
            yield {}, _cloud(message)


def read_transforms(path: str, topics: Sequence[str]) -> Iterator[Message]:
    """Yield, for each pair of frames of Odometry, PoseStamped or tf topics, the stamps (N,) and poses (N, 7).

    A pose is x, y, z, qx, qy, qz, qw of `child` in `parent`; a PoseStamped has no child.
    """
    found: dict[tuple[str, str, bool], list[tuple[int, list[float]]]] = {}
    n_poses = 0
    with _bag(path) as bag:
        for message, topic in _messages(bag, topics):
            for parent, child, stamp, pose in _transforms(message):
                n_poses += 1
                if n_poses > _MOST_POSES:
                    raise ValueError(f"more than {_MOST_POSES} poses")
                found.setdefault((parent, child, topic.endswith("_static")), []).append((stamp, pose))
    for (parent, child, is_static), rows in found.items():
        about = {"parent": parent, "child": child, "is_static": is_static}
        stamps, poses = zip(*rows, strict=True)
        yield about, {"stamps": np.array(stamps, np.int64), "poses": np.array(poses, np.float64)}


def _transforms(message: Any) -> Iterator[tuple[str, str, int, list[float]]]:
    if hasattr(message, "transforms"):
        for each in message.transforms:
            at, turn = each.transform.translation, each.transform.rotation
            numbers = [float(n) for n in (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)]
            names = str(each.header.frame_id).lstrip("/"), str(each.child_frame_id).lstrip("/")
            yield *names, _nanoseconds(each.header.stamp), numbers
        return
    pose = message.pose.pose if hasattr(message, "child_frame_id") else message.pose
    at, turn = pose.position, pose.orientation
    numbers = [float(n) for n in (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)]
    child = str(getattr(message, "child_frame_id", "")).lstrip("/")
    yield str(message.header.frame_id).lstrip("/"), child, _nanoseconds(message.header.stamp), numbers


def _cloud(message: Any) -> dict[str, Any]:
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    data = np.asarray(message.data, np.uint8)
    n_points = height * width
    if not 0 <= n_points <= _MOST_POINTS or step <= 0:
        raise ValueError(f"a cloud of {height} x {width} points of {step} bytes")
    row = int(message.row_step) or width * step
    if row < width * step or len(data) < (height - 1) * row + width * step:
        raise ValueError(f"a cloud announces {n_points} points of {step} bytes and holds {len(data)} bytes")
    if row != width * step:  # rows with padding
        data = np.concatenate([data[line * row : line * row + width * step] for line in range(height)])
    table = np.frombuffer(data[: n_points * step].tobytes(), _dtype(message, step), n_points)
    arrays = {"points": np.column_stack([table[axis] for axis in "xyz"])}
    time = next((name for name in table.dtype.names or () if name.lower() in TIME_FIELDS), None)
    if time is not None and table[time].ndim == 1:
        arrays["times"] = np.ascontiguousarray(table[time].astype(table[time].dtype.newbyteorder("=")))
    shone = field_of(table.dtype.names or (), INTENSITY_FIELDS)
    if shone is not None and table[shone].ndim == 1:
        arrays["intensity"] = np.ascontiguousarray(table[shone].astype(table[shone].dtype.newbyteorder("=")))
    return arrays


def _dtype(message: Any, step: int) -> np.dtype[Any]:
    order = ">" if message.is_bigendian else "<"
    fields: dict[str, tuple[str, int]] = {}
    for each in message.fields:
        kind, offset = _FIELD_TYPES.get(int(each.datatype)), int(each.offset)
        if kind is not None and int(each.count) <= 1 and 0 <= offset <= step - int(kind[1]):
            fields.setdefault(str(each.name), (order + kind, offset))
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"the fields of a cloud are {', '.join(fields)[:80]}: expected x, y and z")
    kinds, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": list(kinds), "offsets": list(offsets), "itemsize": step})


def _messages(bag: Any, topics: Sequence[str]) -> Iterator[tuple[Any, str]]:
    wanted = [each for each in bag.connections if each.topic in topics]
    if wanted:
        for connection, _, raw in bag.messages(connections=wanted):
            yield bag.deserialize(raw, connection.msgtype), str(connection.topic)


def _nanoseconds(stamp: Any) -> int:
    found = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if not 0 <= found < 2**62:
        raise ValueError(f"a stamp is {stamp.sec} s")
    return found


@contextmanager
def _bag(path: str) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(f"{path}: a bag needs a package more: pip install 'tunnelcd[formats]'") from error
    try:
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            whole = _as_bag(Path(path), Path(folder))
            with AnyReader([whole], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
                _keep_chunks_at_0(bag)
                yield bag
    except InputError:
        raise
    except Exception as error:
        if not isinstance(error, _ERRORS) and type(error).__module__.split(".")[0] not in _LIBRARIES:
            raise
        told = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a readable bag: {told[:300]}") from error


def _keep_chunks_at_0(bag: Any) -> None:
    """Let chunks of MCAP that begin at time 0 begin before: rosbags takes them for chunks without messages."""
    for reader in bag.readers:
        for file in getattr(getattr(reader, "storage", None), "readers", ()):
            for place, chunk in enumerate(getattr(file, "chunks", ())):
                if chunk.message_start_time == 0 and chunk.channel_count:
                    file.chunks[place] = chunk._replace(message_start_time=-1)


_MCAP, _SQLITE = b"\x89MCAP", b"SQLite format 3"
_LIBRARIES = ("rosbags", "sqlite3", "zstandard", "lz4", "ruamel", "struct")


def _as_bag(path: Path, folder: Path) -> Path:
    """Return what rosbags opens: the file of a ROS 1 bag, or a folder with metadata.yaml, made for a lone file."""
    if path.is_dir():
        for each in path.iterdir():
            if not each.is_dir():
                require_plain_file(each)
        if (path / "metadata.yaml").is_file():
            return path
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".bag"))
        if len(files) != 1:
            raise ValueError(f"{len(files)} files without a metadata.yaml: name one of them")
        path = files[0]
    require_plain_file(path)
    with path.open("rb") as file:
        head = file.read(16)
    if head.startswith(b"#ROSBAG"):
        return path
    if not head.startswith((_MCAP, _SQLITE)):
        raise ValueError(
            f"it begins with none of {b'#ROSBAG'!r}, {_MCAP!r} and {_SQLITE!r}: cut short or no bag: copy or record it "
            "again"
        )
    (folder / path.name).symlink_to(path.absolute())
    is_mcap = head.startswith(_MCAP)
    topics = _topics_of_mcap(path) if is_mcap else _topics_of_sqlite(path)
    about = {
        "version": 5,
        "storage_identifier": "mcap" if is_mcap else "sqlite3",
        "relative_file_paths": [path.name],
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
    (folder / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": about}), encoding="utf-8")
    return folder


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
