"""Bags that RViz and Foxglove play: ROS 2 with sqlite3 (a folder), MCAP, and ROS 1.

    /points   PointCloud2 in frame `lidar`, stamped at the first column: x, y, z, t, intensity, ring, and added fields
    /tf       `lidar` in `odom`, 21 times in each revolution
    /clock    at the same times

Points of a session are not deskewed: `t` and /tf say where each was taken. Those of other recordings, and
of bare points that `graft` was given, are, without `t`.
"""

# ruff: noqa: PLC0415 - rosbags and mcap are extras, and everybody else must be able to import this

from __future__ import annotations

import errno
import inspect
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.names import ADDRESS_MARKS
from cdpipe.core.plugins import require_extra
from cdpipe.core.progress import Progress
from cdpipe.io.out.ros import CLOCK, CLOUD, TRANSFORMS, RosMessages
from cdpipe.io.out.scans import Outgoing

TOPICS = {"/points": CLOUD, "/tf": TRANSFORMS, "/clock": CLOCK}
_Write = Callable[[str, int, bytes], None]
_MOST_S = 2**31 - 1  # int32 seconds of builtin_interfaces/Time, as which rosbags writes the time of ROS 1, too
_VERSION = 8  # of the metadata of a ROS 2 bag; newer versions of rosbags ask for it


def write_bag(path: Path, outgoing: Outgoing, kind: str, report: Progress) -> None:
    """Write a session or recording as a bag.

    Args:
        path: New file; of `ros2` a new folder.
        outgoing: What to write.
        kind: "ros1", "ros2" or "mcap".
        report: Called with the stage, the number of finished scans and their total.

    Raises:
        InputError: The extra `formats` is not installed, ROS cannot hold the times, it is a map without its scans, or
            a scan cannot be read.
        OSError: The file cannot be written.
    """
    require_extra("formats", str(path))
    outgoing.require_scans()
    _require_times(outgoing)
    messages = RosMessages(is_first=kind == "ros1")
    opened = _open_mcap(path, messages) if kind == "mcap" else _open_bag(path, messages)
    with opened as write:
        for scan in outgoing.sweeps(report):
            for stamp_ns, pose in zip(scan.path_ns.tolist(), scan.path, strict=True):
                write("/clock", stamp_ns, messages.serialize(CLOCK, messages.clock(stamp_ns)))
                write("/tf", stamp_ns, messages.serialize(TRANSFORMS, messages.transform(stamp_ns, pose)))
            # a driver sends a revolution when it is complete
            write("/points", int(scan.path_ns[-1]), messages.serialize(CLOUD, messages.cloud(scan)))


def _require_times(outgoing: Outgoing) -> None:
    first_s, last_s = outgoing.span_s()
    if not 0 <= first_s <= last_s < _MOST_S + 1:
        raise InputError(
            f"{outgoing.name}: its times are {first_s:.10g} to {last_s:.10g} s, ROS holds 0 to {_MOST_S} s: give its "
            "scans and poses seconds of Unix time, or since its start"
        )


@contextmanager
def _open_bag(path: Path, messages: RosMessages) -> Iterator[_Write]:
    from rosbags import rosbag1, rosbag2

    make: Any = rosbag1.Writer if messages.is_first else rosbag2.Writer
    options = {"version": _VERSION} if "version" in inspect.signature(make).parameters else {}
    try:
        with ExitStack() as stack:
            if not messages.is_first and ADDRESS_MARKS.search(str(path.absolute())):
                # rosbags asks SQLite for `file:PATH`, which would be another file
                link = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tunnelcd-")), "to")
                link.symlink_to(path.parent.absolute())
                path = link / path.name
            bag = stack.enter_context(make(path, **options))
            topics = {
                topic: bag.add_connection(topic, kind, typestore=messages.store) for topic, kind in TOPICS.items()
            }
            yield lambda topic, stamp_ns, content: bag.write(topics[topic], stamp_ns, content)
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error)) from error


@contextmanager
def _open_mcap(path: Path, messages: RosMessages) -> Iterator[_Write]:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start(profile="ros2", library="tunnelcd")
        channels = {}
        for topic, kind in TOPICS.items():
            text, _ = messages.store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)

        def write(topic: str, stamp_ns: int, content: bytes) -> None:
            # some readers take a chunk that begins at time 0 for one without messages
            writer.add_message(channels[topic], max(stamp_ns, 1), content, max(stamp_ns, 1))

        yield write
        writer.finish()
