"""Bags: the scans of one PointCloud2 topic, and poses of the sensor from tf, Odometry or PoseStamped."""

from __future__ import annotations

import shutil
import warnings
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.isolated_reader import IsolatedReader
from cdpipe.core.names import visible
from cdpipe.core.plugins import require_extra
from cdpipe.core.progress import Progress
from cdpipe.io.foreign.bag_files import CLOUD, ODOMETRY, POSE, TRANSFORMS
from cdpipe.io.foreign.clouds import Cloud, check_cloud
from cdpipe.io.foreign.frames import (
    FIXED,
    NO_SENSOR,
    Edge,
    compose,
    find_chain,
    find_mounting,
    is_base,
    is_fixed,
    make_edge,
)
from cdpipe.io.foreign.packed_bags import unpack_bag
from cdpipe.io.foreign.trajectory import Trajectory, find_gaps
from cdpipe.io.tum import are_poses

_LISTED = 8
_MOST_WRONG = 0.05  # share of Odometry or PoseStamped messages that may hold no pose, as the first of a filter do
_MOST_WAITING = 64  # clouds in memory while they are sorted: 200 MB of 130,000 points each


class BagScans:
    """The scans of a bag: `Clouds`. Scans outside the time of its poses are left out, which a warning says."""

    is_stream = True

    def __init__(self, path: Path, topics: Sequence[str], is_posed: bool, report: Progress) -> None:
        """List the topics, choose that of the clouds, look through these, and read the poses.

        Args:
            path: The bag.
            topics: Topics that a person names.
            is_posed: Whether the poses come from elsewhere.
            report: Called with "look through", the number of clouds looked at and the number that is announced.

        Raises:
            InputError: It is no bag, holds no clouds or several topics of them, or its poses cannot be used.
        """
        require_extra("formats", str(path))
        self.name = str(path)
        self.own: Trajectory | None = None
        self._path, self._reader = path, IsolatedReader("cdpipe.io.foreign.bag_files", path, "rosbags")
        unpacked = unpack_bag(path, self._reader)
        if unpacked is not None:
            weakref.finalize(self, shutil.rmtree, unpacked.parent, ignore_errors=True)
        self._source = str(unpacked or path)
        ((about, _),) = self._reader.read("list_topics", path=self._source)
        self._topics = [(name, kind, count) for name, kind, count in about["topics"] if count]
        unknown = sorted(set(topics) - {name for name, *_ in self._topics})
        if unknown:
            raise InputError(f"{path}: --topic {unknown[0]}: not in it: it holds {self._listed()}")
        self._topic = self._choose(CLOUD, topics, "PointCloud2")
        stamps, has_returns = self._look_through(report)
        # cloud of the topic that each scan is, scans in the order of their stamps
        self._numbers = self._sort(np.flatnonzero(self._find_returns(has_returns)), stamps)
        stamps = stamps[self._numbers]
        self.stamps_s: Float64Array | None = stamps / 1e9
        self.lacks = f"no poses of the sensor in it (it holds {self._listed()})"
        if is_posed and self._frame in NO_SENSOR:
            told = f"its frame is {self._frame}, which does not move with the sensor: where the clouds are registered"
            warnings.warn(f"{path}: {self._topic}: {told} already, name the raw ones", InputWarning, stacklevel=2)
        if not is_posed:
            self.own = self._find_poses(topics)
            if self.own is not None:
                self._leave_out(stamps / 1e9, self.own)

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._numbers)

    def where(self, index: int) -> str:
        """Name a scan."""
        return f"{self._path}: {self._topic}: cloud {int(self._numbers[index])}"

    def read(self, index: int) -> Cloud:
        """Read one scan, and all before it."""
        return next(cloud for number, cloud in enumerate(self.read_all()) if number == index)

    def read_all(self) -> Iterator[Cloud]:
        """Read all scans in order; points that are not finite are missing returns."""
        messages = self._reader.read("read_clouds", path=self._source, topic=self._topic)
        places = {number: place for place, number in enumerate(self._numbers.tolist())}
        waiting: dict[int, Cloud] = {}
        done = 0
        for number, (_, arrays) in enumerate(messages):
            if number not in places:
                continue
            cloud = check_cloud(f"{self._path}: {self._topic}: cloud {number}", arrays)
            cloud.points[np.flatnonzero(~np.isfinite(cloud.points).all(axis=1))] = 0.0
            waiting[places[number]] = cloud
            while done in waiting:
                yield waiting.pop(done)
                done += 1

    def _look_through(self, report: Progress) -> tuple[Int64Array, BoolArray]:
        """Return the stamps (S,) of the clouds and whether each has returns, and keep their frame."""
        n_announced = sum(count for name, _, count in self._topics if name == self._topic)
        stamps, has_returns = [np.zeros(0, np.int64)], [np.zeros(0, np.bool_)]
        frames: set[str] = set()
        n_done = 0
        report("look through", n_done, n_announced)
        for about, arrays in self._reader.read("read_stamps", path=self._source, topic=self._topic):
            frames.update(str(frame) for frame in about["frames"])
            stamps.append(arrays["stamps"])
            has_returns.append(arrays["has_returns"] > 0)
            n_done += len(stamps[-1])
            report("look through", n_done, max(n_done, n_announced))
        self._frame = self._require_one_frame(sorted(frames)[:_LISTED])
        if not n_done:
            raise InputError(f"{self._path}: {self._topic}: no cloud can be read from it")
        if n_done < n_announced:
            told = f"{n_done} of {n_announced} clouds can be read: the bag is cut short or damaged: copy it again"
            warnings.warn(f"{self._path}: {self._topic}: {told}", InputWarning, stacklevel=2)
        report("look through", n_done, n_done)
        return np.concatenate(stamps), np.concatenate(has_returns)

    def _sort(self, numbers: Int64Array, stamps: Int64Array) -> Int64Array:
        """Return the clouds (S,) in the order of their stamps, each stamp once."""
        unique, first = np.unique(stamps[numbers], return_index=True)
        n_repeats, where = len(numbers) - len(unique), f"{self._path}: {self._topic}"
        if n_repeats > len(unique):
            raise InputError(
                f"{where}: too few stamps ({len(unique)} on {len(numbers)} clouds): header.stamp was not set: "
                "set it and record again, or rewrite the stamps"
            )
        if n_repeats:
            told = f"{n_repeats} of {len(numbers)} clouds have the stamp of another one, and are left out"
            warnings.warn(f"{where}: {told}", InputWarning, stacklevel=2)
        places = np.argsort(np.argsort(first))
        n_waiting = int((np.maximum.accumulate(places) - np.arange(len(places))).max(initial=0))
        if n_waiting > _MOST_WAITING:
            raise InputError(
                f"{where}: its clouds are up to {n_waiting} places out of the order of their stamps, at most "
                f"{_MOST_WAITING} can be sorted: write the bag again in the order of header.stamp"
            )
        n_late = int(np.count_nonzero(np.diff(first) < 0))
        if n_late:
            told = f"{n_late} clouds come after one with a later stamp, and are sorted by header.stamp"
            warnings.warn(f"{where}: {told}", InputWarning, stacklevel=2)
        return numbers[first]

    def _choose(self, kind: str, topics: Sequence[str], what: str) -> str:
        found = [name for name, its_kind, _ in self._topics if its_kind == kind]
        named = [name for name in found if name in topics]
        if len(named or found) == 1:
            return str((named or found)[0])
        if found:
            raise InputError(
                f"{self._path}: {len(found)} topics of {what}: name one, --topic {' or '.join(sorted(found))}"
            )
        raise InputError(f"{self._path}: no topic of {what}: it holds {self._listed()}")

    def _listed(self) -> str:
        told = [f"{visible(name)} ({kind.rsplit('/', 1)[-1]}, {count})" for name, kind, count in sorted(self._topics)]
        more = f" and {len(told) - _LISTED} more" if len(told) > _LISTED else ""
        return (", ".join(told[:_LISTED]) or "no message") + more

    def _find_returns(self, has_returns: BoolArray) -> BoolArray:
        """Return which clouds (S,) to read: those with a return."""
        n_empty = int(np.count_nonzero(~has_returns))
        if n_empty == len(has_returns):
            raise InputError(f"{self._path}: {self._topic}: none of its {n_empty} clouds holds a return")
        if n_empty:
            told = f"{n_empty} of {len(has_returns)} clouds hold no return, and are left out"
            warnings.warn(f"{self._path}: {told}", InputWarning, stacklevel=2)
        return has_returns

    def _require_one_frame(self, frames: Sequence[str]) -> str:
        """Return the frame of the clouds, "" where they name none; refuse those of several sensors on one topic."""
        if len(frames) > 1:
            told = ", ".join(map(visible, frames))
            raise InputError(
                f"{self._path}: {self._topic}: its clouds are of several frames ({told}), and so of several sensors: "
                "record one topic for each"
            )
        return frames[0] if frames else ""

    def _leave_out(self, stamps_s: Float64Array, own: Trajectory) -> None:
        assert own.time_s is not None
        slack_s = max(float(np.median(np.diff(times))) if len(times) > 1 else 0.0 for times in (stamps_s, own.time_s))
        is_inside = (stamps_s >= own.time_s[0] - slack_s) & (stamps_s <= own.time_s[-1] + slack_s)
        if not is_inside.any():
            raise InputError(
                f"{self._path}: its poses ({own.time_s[0]:.3f} to {own.time_s[-1]:.3f} s) and its clouds "
                f"({stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s) are of different times: give --trajectory FILE"
            )
        gaps_s, longest_s = find_gaps(own, stamps_s)
        is_known = is_inside & (gaps_s <= longest_s)
        n_out = int(np.count_nonzero(~is_known))
        places = "before or after its poses"
        if (gaps_s[is_inside] > longest_s).any():
            places += f", or where these pause for more than {longest_s:.2g} s"
        if n_out == len(stamps_s):
            raise InputError(f"{self._path}: all of its {n_out} clouds lie {places}: give --trajectory FILE")
        if n_out:
            told = f"{n_out} of {len(stamps_s)} clouds lie {places}, and are left out"
            warnings.warn(f"{self._path}: {told}", InputWarning, stacklevel=2)
        self._numbers = self._numbers[is_known]
        self.stamps_s = stamps_s[is_known]

    def _find_poses(self, topics: Sequence[str]) -> Trajectory | None:
        """Return poses by a named topic; else by tf that moves below a fixed frame, Odometry, PoseStamped, other tf."""
        edges = self._read_edges([name for name, kind, _ in self._topics if kind == TRANSFORMS], is_tf=True)
        named = [(name, kind) for name, kind, _ in self._topics if name in topics and kind in (ODOMETRY, POSE)]
        chain = find_chain(edges, self._frame)
        is_moving = any(edge.is_moving for edge in chain)
        if not named and is_moving and chain[0].parent in FIXED:
            return compose(f"tf of {self._path}", chain)
        for kind in (ODOMETRY, POSE):
            found = [name for name, its_kind in named if its_kind == kind]
            if found or (not named and any(its_kind == kind for _, its_kind, _ in self._topics)):
                return self._read_poses(self._choose(kind, topics, kind.rsplit("/", 1)[-1]), edges)
        is_standing = not is_moving and any(len(edge.time_s) > 1 for edge in chain) and chain[0].parent in FIXED
        if is_standing:
            told = f"by its tf {visible(self._frame)} stands in {visible(chain[0].parent)}, and so does the sensor"
            warnings.warn(f"{self._path}: {told}", InputWarning, stacklevel=2)
        if is_moving and not is_fixed(chain[0].parent) and self._is_part(chain[0].parent):
            return None
        return compose(f"tf of {self._path}", chain) if is_moving or is_standing else None

    def _is_part(self, root: str) -> bool:
        """Tell whether the frame above all others is a part of the robot by its name; warn where it may be one."""
        told = f"tf moves {visible(self._frame)} in {visible(root)} alone"
        if is_base(root):
            self.lacks += f", and {told}, a part of the robot"
            return True
        told += ", which is taken for a fixed frame: where it is a part of the robot, give --odometry kiss-icp"
        warnings.warn(f"{self._path}: {told}", InputWarning, stacklevel=2)
        return False

    def _read_poses(self, topic: str, edges: dict[str, Edge]) -> Trajectory | None:
        """Return the poses of one topic, with the fixed mounting of the sensor on what they are poses of.

        Clouds in the frame that the poses lie in are registered already, as those of LOAM and its kin are.
        """
        where = f"{topic} of {self._path}"
        for child, edge in self._read_edges([topic]).items():
            if self._frame and self._frame == edge.parent:
                told = f"its clouds are in {visible(self._frame)}, the frame of the poses of {topic}"
                told += ": they are taken as registered, and moved back"
                warnings.warn(f"{self._path}: {self._topic}: {told}", InputWarning, stacklevel=2)
                found = compose(where, [edge])
                return found and replace(found, holds_clouds=True)
            if child == self._frame:
                return compose(where, [edge])
            mounting = find_mounting(edges, child, self._frame) if child else []
            if not mounting:
                self._warn_of_base(topic, child, edges)
            return compose(where, [edge, *mounting])
        return None

    def _warn_of_base(self, topic: str, child: str, edges: dict[str, Edge]) -> None:
        """Warn that poses may be those of a base, and are taken for the sensor's."""
        sensor = visible(self._frame)
        if child:
            told = f"{topic} has the poses of {visible(child)}, and no tf tells where {sensor} is on it"
        elif self._frame in edges:
            told = f"the poses of {topic} name no frame, and tf has {sensor} on {visible(edges[self._frame].parent)}"
        else:
            return
        told += ": they are taken for those of the sensor: where they are not, give --trajectory FILE"
        warnings.warn(f"{self._path}: {told}", InputWarning, stacklevel=2)

    def _read_edges(self, topics: Sequence[str], *, is_tf: bool = False) -> dict[str, Edge]:
        """Return the edge above each frame, by the frame; a frame with two parents keeps the one that moves.

        Transforms of tf that are no poses are left out, as they may be of any part of a robot. So are messages of
        poses, if they are few.
        """
        edges: dict[str, Edge] = {}
        only = {"frame": self._frame} if is_tf else {}
        asked: dict[str, Any] = {"path": self._source, "topics": list(topics), **only}
        found = list(self._reader.read("read_transforms", **asked)) if topics else []
        wrong = [~are_poses(arrays["poses"]) for _, arrays in found]
        n_wrong = sum(int(np.count_nonzero(each)) for each in wrong)
        leaves_out = is_tf or n_wrong <= _MOST_WRONG * sum(len(each) for each in wrong)
        for (about, arrays), is_wrong in zip(found, wrong, strict=True):
            parent, child = str(about["parent"]), str(about["child"])
            where = f"{self._path}: {visible(child)} in {visible(parent)}"
            stamps, rows = arrays["stamps"], arrays["poses"]
            if leaves_out and is_wrong.any():
                what = "transforms are" if is_tf else "messages hold"
                told = f"{np.count_nonzero(is_wrong)} of {len(rows)} {what} no poses, and are left out"
                warnings.warn(f"{where}: {told}", InputWarning, stacklevel=2)
                stamps, rows = stamps[~is_wrong], rows[~is_wrong]
                if not len(rows):
                    continue
            edge = make_edge(where, parent, stamps, rows, is_static=bool(about["is_static"]))
            if child not in edges or len(edge.time_s) > len(edges[child].time_s):
                edges[child] = edge
        return edges
