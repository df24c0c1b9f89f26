"""Calls of rosbags on foreign bags; they run in a process of their own (`cdpipe.core.isolated_reader`).

ROS 1 bags, ROS 2 bags (a folder with metadata.yaml, or one .db3) and MCAP. No ROS is needed.
"""

# ruff: noqa: PLC0415 - rosbags is an extra, and it is imported in the process that reads

from __future__ import annotations

import json
import tempfile
import warnings
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.isolated_reader import Message
from cdpipe.core.names import visible
from cdpipe.io.foreign.bag_layout import find_paths, list_packed_topics, read_packed, require_one_recording
from cdpipe.io.foreign.clouds import INTENSITY_FIELDS, TIME_FIELDS, field_of

CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_OLD_TRANSFORMS = "tf/msg/tfMessage"
# Numbers of sensor_msgs/PointField.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_POINTS = 10_000_000
_MOST_POSES, _MOST_TRANSFORMS = 2_000_000, 20_000_000  # of one frame, and of all: 64 bytes each
_OTHER_POSES = ": give --trajectory FILE, or --odometry kiss-icp"
# What mends a bag that was cut short, by the end of its name.
_WAYS_OUT = {
    ".bag": ": if it was cut short, `rosbag reindex FILE` of ROS 1 mends it",
    ".mcap": ": if it was cut short, `mcap recover FILE -o NEW` mends it",
    ".db3": ": if it was cut short, `sqlite3 FILE .recover | sqlite3 NEW` mends it",
}
_MOST_TOPICS = 10_000
_MOST_FRAMES = 8
_STAMPS_AT_ONCE = 50  # 5 s of a recording
_BLOCK_BYTES = 8 << 20
_LIBRARIES = ("rosbags", "sqlite3", "zstandard", "lz4", "ruamel", "struct")
_ERRORS = (
    OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, AssertionError,
    UnicodeError, EOFError,
)  # fmt: skip


def list_topics(path: str) -> Iterator[Message]:
    """Yield one dict: `topics`, for each its name, type and number of messages.

    A file-compressed bag says them in its metadata; it is not decompressed for them.
    """
    with _tells(path):
        named = list_packed_topics(Path(path))
    if named:
        yield {"topics": named}, {}
        return
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


def read_transforms(path: str, topics: Sequence[str], frame: str | None = None) -> Iterator[Message]:
    """Yield, for each pair of frames of Odometry, PoseStamped or tf topics, the stamps (N,) and poses (N, 7).

    A pose is x, y, z, qx, qy, qz, qw of `child` in `parent`; a PoseStamped has no child. With `frame`, only pairs above
    it and above what Odometry is of: a robot may have a hundred joints elsewhere.
    """
    found: dict[tuple[str, str, bool], tuple[array[int], array[float]]] = {}
    n_poses = 0
    with _bag(path) as bag:
        for message, topic in _messages(bag, topics):
            for parent, child, stamp, pose in _transforms(message):
                n_poses += 1
                if n_poses > _MOST_TRANSFORMS:
                    raise InputError(f"{path}: more than {_MOST_TRANSFORMS} transforms{_OTHER_POSES}")
                key = parent, child, topic.endswith("_static")
                stamps, poses = found.setdefault(key, (array("q"), array("d")))
                stamps.append(stamp)
                poses.extend(pose)
        kept = None if frame is None else _find_above({*_tracked(bag), frame}, found)
    for (parent, child, is_static), (stamps, poses) in found.items():
        if kept is not None and child not in kept:
            continue
        if len(stamps) > _MOST_POSES:
            raise InputError(
                f"{path}: more than {_MOST_POSES} poses of {visible(child)} in {visible(parent)}{_OTHER_POSES}"
            )
        about = {"parent": parent, "child": child, "is_static": is_static}
        yield about, {"stamps": np.array(stamps, np.int64), "poses": np.array(poses, np.float64).reshape(-1, 7)}


def _find_above(frames: set[str], pairs: Iterable[tuple[str, str, bool]]) -> set[str]:
    """Return frames and all frames above them."""
    while more := {parent for parent, child, _ in pairs if child in frames} - frames:
        frames = frames | more
    return frames


def _tracked(bag: Any) -> set[str]:
    """Return the frames of which the Odometry of a bag is, by its first messages; of unreadable ones none."""
    frames: set[str] = set()
    for topic in {each.topic for each in bag.connections if each.msgtype == ODOMETRY}:
        with suppress(Exception):
            frames.update(
                child for message, _ in islice(_messages(bag, [topic]), 10) for _, child, *_ in _transforms(message)
            )
    return frames


def unpack(path: str) -> Iterator[Message]:
    """Yield the metadata of a file-compressed ROS 2 bag, as JSON, then its files, decompressed, block by block.

    Of another bag nothing is yielded.
    """
    import zstandard

    with _tells(path):
        about, names = read_packed(Path(path))
        if names:
            yield {"metadata": json.dumps(about)}, {}
        for name in names:
            with (
                (Path(path) / name).open("rb") as file,
                zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True) as plain,
            ):
                while block := plain.read(_BLOCK_BYTES):
                    yield {"file": Path(name).stem}, {"block": np.frombuffer(block, np.uint8)}


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
    if n_points == 0:  # whose fields and steps some drivers leave at 0
        return {"points": np.zeros((0, 3))}
    if not 0 <= n_points <= _MOST_POINTS or step <= 0:
        raise ValueError(f"a cloud of {height} x {width} points of {step} bytes")
    has_padding = height > 1 and len(data) != n_points * step  # else nothing asks for the row's step
    row = (int(message.row_step) if has_padding else 0) or width * step
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
    with _tells(path), tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with _tells(path, _way_out(Path(path))):
            found = find_paths(Path(path), Path(folder))
            reader = AnyReader(found, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        with closing(reader) as bag:
            require_one_recording(bag.readers)
            _keep_chunks_at_0(bag)
            yield bag


def _way_out(path: Path) -> str:
    """Return what mends a bag that was cut short, "" where its kind is not known."""
    named = [path] if path.is_file() else list(path.iterdir()) if path.is_dir() else []
    ways = {_WAYS_OUT[file.suffix.lower()] for file in named if file.suffix.lower() in _WAYS_OUT}
    return ways.pop() if len(ways) == 1 else ""


@contextmanager
def _tells(path: str, way_out: str = "") -> Iterator[None]:
    """Let what a damaged bag provokes become one `InputError`.

    The way out stands at its end where the library could not read the bag; errors of ours (`ValueError`) say their own.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if not isinstance(error, _ERRORS) and type(error).__module__.split(".")[0] not in _LIBRARIES:
            raise
        told = " ".join(str(error).split()) or type(error).__name__
        is_other = isinstance(error, (ValueError, OSError, LookupError)) or type(error).__module__.startswith("ruamel")
        end = "" if is_other else way_out
        raise InputError(f"{path}: not a readable bag: {told[:300]}{end}") from error


def _keep_chunks_at_0(bag: Any) -> None:
    """Let chunks of MCAP that begin at time 0 begin before: rosbags takes them for chunks without messages."""
    for reader in bag.readers:
        for file in getattr(getattr(reader, "storage", None), "readers", ()):
            for place, chunk in enumerate(getattr(file, "chunks", ())):
                if chunk.message_start_time == 0 and chunk.channel_count:
                    file.chunks[place] = chunk._replace(message_start_time=-1)
