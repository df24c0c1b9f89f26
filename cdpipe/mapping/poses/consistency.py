"""A session's own map made consistent: every scan is registered once more with the scans around it.

Odometry errs from scan to scan, mostly along the drift and in roll. Walls then stand twice in the map, centimetres
apart, and metres where the odometry found no start. Here each scan is registered, point to plane, with the map of other
scans within a few metres of path. The relative pose of the odometry to its neighbours is the prior: it decides where
the walls do not.

1. From the middle of the session to both ends, each scan is registered with the scans before it, and the odometry is
   mended where it lost its way (`following.py`).
2. Sweeps register every scan with those on both sides (`_sweep`): first each with every second scan alone, never
   with itself, as a scan that is off would find itself; then with all, which ties even and odd scans together.
3. A scan that no pose lays on the walls is bent: the sensor was shaken within the revolution. Its points are left out.
4. Where the session comes through a place that it knows, the loop is closed (`loops.py`), and the scans of both
   passes are registered with one another.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.mapping.poses.following import FOLLOWING, Mended, follow, mend_odometry
from cdpipe.mapping.poses.loops import Loop, close_loops, find_loops
from cdpipe.mapping.poses.scan_registration import Registration, Samples, Target, moved_m, register_scan
from cdpipe.model.types import PosedScan, ScanSource, WrappedScans

# A block of path is registered with one map: its scans, and those within this way before and after it.
_BLOCK_M, _AROUND_M = 4.0, 6.0
# Scans agree already if a sweep by halves moves nine of ten by no more than this, turns included, at the distance of a
# wall: 0.1 to 1.2 cm at constant drift or with true poses, 6 cm hand-held (validation tunnels).
_AGREE_M = 0.015
# There is a jump before a scan that moves by more when it is registered with the scans before it. The most of a session
# is 1 to 6 cm at constant drift or with true poses, 9 cm in mist or among movers (the same tunnels).
_JUMP_M = 0.15
# There is one, too, if so many more of its points are off the walls than of the median block's: at jumps of 1 to 2.5 m
# and turns of 58 to 180 degrees 0.29 and more, elsewhere 0.05 at most.
_BESIDE_SHARE = 0.2
_MOST_SHARE = 0.5  # a scan with a smaller share of the points of the median one does not tell
# Least share of the recorded way, block by block, that a registration keeps. Five scans each of an OS0-8 on a driving
# car, which lock onto their rings, keep 0.16 and 0.22.
_LEAST_WAY = 0.8
# Rings hold the sensor at the steps that seem wrong if most of these are as short as this, without a turn (an OS0-8's
# are 0.00 to 0.06 m where it drives 0.5 to 4 m, the median 0.02 m), and if by the odometry they are at most so many
# times as long as its other steps: those of a spin or a jump are longer.
_STANDS_M, _STANDS_RAD, _USUAL_STEPS = 0.03, 0.1, 2.0
_ROUNDING = 1e-9  # of an interpolated percentile
# A scan is bent if so many of its points are off the walls, and so many times as many as of the scans around it.
_BENT_SHARE, _BENT_FACTOR = 0.05, 3.0
_BY_HALVES = Registration(voxel_m=0.2, correspondence_m=0.5, robust_m=0.07, step_m=0.1, step_rad=0.01)
_WITH_ALL = Registration(voxel_m=0.2, correspondence_m=0.5, robust_m=0.05, step_m=0.1, step_rad=0.01)


class ConsistentScans(WrappedScans):
    """A session with other poses than those that were recorded, and without the points of (S,) bent scans."""

    def __init__(
        self, source: ScanSource, odom_T_sensor: Float64Array, is_bent: BoolArray, mended: Mended | None = None
    ) -> None:
        super().__init__(source)
        self._poses, self._is_bent, self._mended = odom_T_sensor, is_bent, mended

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) consistent pose of each scan, odom frame."""
        return self._poses

    def over(self, source: ScanSource) -> ConsistentScans:
        """Return the scans of another source with these poses, and without the points of the same bent scans."""
        return ConsistentScans(source, self._poses, self._is_bent, self._mended)

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        return self._corrected(super().scan(index))

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        for scan in super().scans():
            yield self._corrected(scan)

    def _corrected(self, scan: PosedScan) -> PosedScan:
        if self._is_bent[scan.index]:
            scan = replace(scan.keep(slice(0)), airborne_sensor=None)
        elif self._mended is not None:
            scan = self._mended.deskewed(scan, self._poses)
        return replace(scan, odom_T_sensor=self._poses[scan.index])


def make_consistent(
    source: ScanSource, *, has_loops: bool = False, on_step: Progress = report_nothing
) -> ConsistentScans:
    """Return a session with poses under which its scans agree with one another; the recorded ones where they do so.

    Time grows with the number of scans; the points of a long session are in a temporary file, except those of scans
    that are deskewed anew (0.1 MB each).

    Args:
        source: The session.
        has_loops: Whether loops are closed.
        on_step: Told how many scans were registered each time that all are: step `registration 1`, and so on.

    Raises:
        InputError: A scan cannot be read.
    """
    recorded = source.odom_T_sensor
    is_bent = np.zeros(len(recorded), dtype=np.bool_)
    if len(recorded) == 1:
        return ConsistentScans(source, recorded, is_bent)
    mended: Mended | None = None
    scans, told = Samples(source), _Told(on_step, len(recorded))
    poses, is_kept = scans.odometry, _agree(scans, scans.odometry, told)
    if not is_kept:
        told.begin()
        followed, is_wrong = follow(scans, told.add)
        is_kept = _slides(scans, followed, is_wrong)
        scans.restore()
        if not is_kept and is_wrong.any():
            mended = mend_odometry(scans, followed, is_wrong)
            _warn_of_lost(source, is_wrong)
    if not is_kept:
        poses, off_share = _sweep_all(scans, followed, _BY_HALVES, told, by_halves=True)
        is_bent = _find_bent(scans.path_m, off_share)
        poses, _ = _sweep_all(scans, poses, _WITH_ALL, told)
    loops = find_loops(scans, poses) if has_loops else ()
    if loops:
        poses, _ = _sweep_all(scans, close_loops(scans.path_m, poses, loops), _WITH_ALL, told, loops=loops)
    elif is_kept:
        poses = recorded
    return ConsistentScans(source, poses, is_bent, mended)


def _warn_of_lost(source: ScanSource, is_wrong: BoolArray) -> None:
    n, first = np.count_nonzero(is_wrong), int(np.argmax(is_wrong))
    steps = f"{n} of {len(is_wrong)} steps, first" if n > 1 else "the step"
    told = f"{steps} from scan {first} to {first + 1}, beside the walls, found anew"
    warnings.warn(f"{source.name}: the odometry loses its way: {told}", InputWarning, stacklevel=2)


def _agree(scans: Samples, poses: Float64Array, told: _Told) -> bool:
    """Return whether a sweep moves nine of ten scans by no more than `_AGREE_M`, and there is no jump.

    The sweep ends as soon as its answer is certain.
    """
    n, shifts_m = len(poses), np.zeros(len(poses))
    below = int(0.9 * (n - 1))  # the 90th percentile lies between this one of the sorted values and the next
    n_near = n_far = 0
    for own, found, _ in _sweep(scans, poses, _WITH_ALL, told, by_halves=True):
        shifts_m[own] = moved_m(poses[own], found)
        n_near += int(np.count_nonzero(shifts_m[own] < _AGREE_M * (1 - _ROUNDING)))
        n_far += int(np.count_nonzero(shifts_m[own] > _AGREE_M * (1 + _ROUNDING)))
        if n_near >= below + 2 or n_far >= n - below:
            break
    return not np.percentile(shifts_m, 90) > _AGREE_M and not _has_jump(scans, poses)


def _has_jump(scans: Samples, poses: Float64Array) -> bool:
    """Return whether the last scan of any block moves by more than `_JUMP_M` in the map of the scans before the block.

    Or whether it lies beside the walls there, where no pose near by fits. A sweep does not see one jump: the scans on
    either side of it hold one another.
    """
    path_m, misfits = scans.path_m, []
    bounds = np.append(np.flatnonzero(np.diff(np.floor(path_m / _BLOCK_M))) + 1, len(poses))
    for start, end in pairwise(bounds.tolist()):
        before = np.arange(np.searchsorted(path_m, path_m[start] - _AROUND_M), start)
        if not len(before):
            continue
        last = poses[end - 1]
        target = Target(scans, poses, before, last[:3, 3], FOLLOWING.voxel_m)
        found = register_scan(scans.of_scan(end - 1), last, [last], target, FOLLOWING)
        if moved_m(last[None], found.pose[None])[0] > _JUMP_M:
            return True
        if scans.n_points[end - 1] >= _MOST_SHARE * np.median(scans.n_points):
            misfits.append(found.misfit)
    usual = np.percentile(misfits, 50, method="lower") if misfits else 0.0
    return max(misfits, default=0.0) > usual + _BESIDE_SHARE


def _slides(scans: Samples, poses: Float64Array, is_wrong: BoolArray) -> bool:
    """Return whether the (S, 4, 4) registered poses lost a part of the recorded way, as rings that match rings do.

    Few beams, or scans far apart, meet the ground in rings around the sensor. Where these hold a registration, the
    sensor seems to stand: in whole blocks, or at the steps of the odometry (S - 1,) that seem wrong then.
    """
    steps = (invert(poses[:-1]) @ poses[1:])[is_wrong]
    turns_rad = Rotation.from_matrix(steps[:, :3, :3]).magnitude() if len(steps) else np.zeros(0)
    stands = (np.linalg.norm(steps[:, :3, 3], axis=1) < _STANDS_M) & (turns_rad < _STANDS_RAD)
    if len(steps) and np.mean(stands) > 0.5:
        odometry_m = moved_m(scans.odometry[:-1], scans.odometry[1:])
        usual_m = np.inf if is_wrong.all() else np.median(odometry_m[~is_wrong])
        if np.median(odometry_m[is_wrong]) < _USUAL_STEPS * usual_m:
            return True
    ends = np.append(np.unique(np.floor(scans.path_m / _BLOCK_M), return_index=True)[1], len(poses) - 1)
    way_m, recorded_m = (np.linalg.norm(np.diff(each[ends, :3, 3], axis=0), axis=1) for each in (poses, scans.odometry))
    n_wrong = np.diff(np.append(0, np.cumsum(is_wrong))[ends])
    is_driven = (recorded_m > _BLOCK_M / 4) & (n_wrong == 0)  # the way of a sensor that stands is its jitter
    return bool(way_m[is_driven].sum() < _LEAST_WAY * recorded_m[is_driven].sum())


class _Told:
    """Tells how many scans each registration of all scans has done."""

    def __init__(self, on_step: Progress, total: int) -> None:
        self._on_step, self._total = on_step, total
        self._number = self._done = 0

    def begin(self) -> None:
        self._number, self._done = self._number + 1, 0

    def add(self) -> None:
        self._done += 1
        self._on_step(f"registration {self._number}", self._done, self._total)


def _find_bent(path_m: Float64Array, off_share: Float64Array) -> BoolArray:
    """Return which scans are bent, by (S,) path and (S,) shares of points off the walls."""
    stops_m, stop = np.unique(path_m, return_inverse=True)  # scans of one stop have the same neighbours
    first, end = (np.searchsorted(path_m, stops_m + way_m) for way_m in (-_AROUND_M, _AROUND_M))
    usual = np.array([np.median(off_share[a:b]) for a, b in zip(first, np.maximum(end, first + 1), strict=True)])
    return np.asarray(off_share > np.maximum(_BENT_SHARE, _BENT_FACTOR * usual[stop]))


def _sweep_all(
    scans: Samples, poses: Float64Array, settings: Registration, told: _Told, **choices: Any
) -> tuple[Float64Array, Float64Array]:
    """Return all (S, 4, 4) poses after one `_sweep`, and the (S,) shares; choices are keyword arguments of `_sweep`."""
    found, off_share = poses.copy(), np.zeros(len(poses))
    for own, found_of_block, off_share_of_block in _sweep(scans, poses, settings, told, **choices):
        found[own], off_share[own] = found_of_block, off_share_of_block
    return found, off_share


def _sweep(
    scans: Samples,
    poses: Float64Array,
    settings: Registration,
    told: _Told,
    *,
    by_halves: bool = False,
    loops: tuple[Loop, ...] = (),
) -> Iterator[tuple[Int64Array, Float64Array, Float64Array]]:
    """Register all scans of a block with the poses before it, block by block.

    Args:
        scans: The scans.
        poses: (S, 4, 4) poses.
        settings: Of the registrations.
        told: Told of every scan.
        by_halves: Whether a scan is compared with every second scan alone.
        loops: Closed loops: scans of both passes are registered with one another.

    Yields:
        (B,) scans of a block, their (B, 4, 4) poses, and the (B,) share of each scan's points that are off the walls.
    """
    told.begin()
    steps = invert(scans.odometry[:-1]) @ scans.odometry[1:]
    ends_m = scans.path_m[[each for loop in loops for each in ((loop.scan, loop.other), (loop.other, loop.scan))]]
    blocks = np.floor(scans.path_m / _BLOCK_M)
    for block in np.unique(blocks):
        own = np.flatnonzero(blocks == block)
        near = np.flatnonzero(_is_near(scans.path_m, own[0], own[-1], ends_m.reshape(-1, 2)))
        centre = poses[own[len(own) // 2], :3, 3]
        halves = [near[near % 2 == 1], near[near % 2 == 0]] if by_halves else [near, near]
        if not all(len(half) for half in halves):
            continue
        first = Target(scans, poses, halves[0], centre, settings.voxel_m)
        second = Target(scans, poses, halves[1], centre, settings.voxel_m) if by_halves else first
        found, off_share = poses[own], np.zeros(len(own))
        for number, index in enumerate(own.tolist()):
            predicted = [poses[index - 1] @ steps[index - 1]] if index else []
            predicted += [poses[index + 1] @ invert(steps[index])] if index + 1 < len(poses) else []
            target = first if index % 2 == 0 else second
            at = register_scan(scans.of_scan(index), poses[index], predicted, target, settings)
            found[number], off_share[number] = at.pose, at.off_share
            told.add()
        yield own, found, off_share


def _is_near(path_m: Float64Array, first: int, last: int, ends_m: Float64Array) -> BoolArray:
    """Return which (S,) scans are near to a block of scans along the path, or along another pass of a closed loop.

    Args:
        path_m: (S,) path length at every scan.
        first: First scan of the block.
        last: Last scan of the block.
        ends_m: (L, 2) path length at one end of each loop, and at its other end; each loop both ways.
    """
    is_near: BoolArray = (path_m >= path_m[first] - _AROUND_M) & (path_m <= path_m[last] + _AROUND_M)
    here_m, there_m = ends_m.T
    for there in there_m[(here_m >= path_m[first] - _BLOCK_M) & (here_m <= path_m[last] + _BLOCK_M)]:
        is_near |= np.abs(path_m - there) <= _AROUND_M
    return is_near
