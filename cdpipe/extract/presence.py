"""What does not stand there, according to the session that saw it: a wall that drift doubled, a person, a machine.

Maps drop what their session saw through at once (`cdpipe/mapping/movers.py`). What is left of it, what waited for as
long as the robot was near, and who stood all the while are told here, object by object.

So is bare floor. Where water stands in the other session, that sees the roof in it, as if through the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array, Int64Array, travelled_m
from cdpipe.core.geometry.planes import fit_plane, is_level_sheet
from cdpipe.core.geometry.voxel import cell_keys, cell_means
from cdpipe.extract.crops import SESSIONS
from cdpipe.extract.objects import PointGroup
from cdpipe.extract.people import is_person
from cdpipe.extract.shape import upright_box
from cdpipe.mapping.free_space import PIXEL_HEIGHT_RAD, PIXEL_WIDTH_RAD, REACH_M, look_by_keyframe
from cdpipe.model.config import ExtractConfig
from cdpipe.model.types import KeyframeViews, MergedMaps, PointMap

_CELL_M, _FAR_CELL_M = 0.05, 0.2
# Ratio of seen-through to hit by its own session above which a surface is a double caused by drift, and above which it
# is one if it was mostly seen from afar.
_DOUBLED, _DOUBLED_AFAR = 3.0, 0.4
# The same by keyframes within this way of those that hit it, above which it was on its way. Validation seeds 10010 and
# 10011: 0.45 at most for railings and chairs of `paper/site1`, 0.36 for the objects of eight other families; up to 1.2
# for what maps keep of people and trucks that move.
_ON_ITS_WAY, _PASS_M = 0.6, 5.0
# The lower ratio for what less than two thirds of the scans within that way hit: 0.3 to 1.3 for what maps keep of feet,
# of wheels, of a truck that waits and of rough walls; 0.08 at most for such objects among 142 that changed.
_SELDOM, _SELDOM_ON_ITS_WAY = 2 / 3, 0.3
# The ratio by single pixels of keyframes within `REACH_M` of way: 1.6 at most for 172 changed objects of 14 families;
# 2.4 to 5.3 for five of eight parts of trucks and plumes of dust that the other rules leave.
_PALE = 2.25
# What passes is hit by so few scans, though their neighbours within this way would see it, too.
_FLEETING_SCANS, _FLEETING_M = 2, 2.0
# What waited while the robot was near: keyframes farther off than `REACH_M`, before the first that hit it or after the
# last, and within this way of them, see through so many times the whole of it. At most 0.1 times for 142 changed
# objects, 1 to 25 times for 13 of 19 parts of machines (`dynamic/wide`, `dust/haul`). A hit is 1 in 20 of its cells.
_GONE, _GONE_WAY_M, _HIT_SHARE = 1.0, 60.0, 0.05
# As far as a pixel is not larger than the object.
_FARTHEST_M = 60.0
# A part of a mover: most of its returns lie this near to another part that the same scan hit. Of what maps dropped,
# which may be dust, it is a part if keyframes within `REACH_M` of way also saw through it so many times as often as
# they hit it. In five validation pairs of `dynamic/wide`, `dust/haul` and `dust/narrow` 0.05 times at most for changed
# objects, over 0.24 times for nearly all parts of machines; of these 0.81 or more lies beside what was dropped.
_BESIDE_M, _MOST, _PART = 1.0, 0.5, 0.12
# Floor: thickness of the sheet, reach of the map around it, its columns, fewest points there, height above it. Floor
# that is dry in one session (`water/null` 10020, `water/narrow` 10013) is 0.04 to 0.07 m thick and lies 0.02 to 0.06 m
# lower. Of 47 objects that changed the flattest, 0.10 to 0.14 m thick, stand 0.05 m and more above it.
_SHEET_M, _AROUND_M, _COLUMN_M, _LEAST_AROUND, _ABOVE_M = 0.1, 0.6, 0.2, 20, 0.02


def keep_what_stands(merged: MergedMaps, objects: list[PointGroup], config: ExtractConfig) -> list[PointGroup]:
    """Return the objects without floor, doubles of walls and, if movers are dropped, without people and machines."""
    rejected: set[int] = set()
    for name in SESSIONS:
        point_map = merged.map_of(name)
        if point_map.views is None:
            continue
        sights = {
            index: Sight(point_map, each.returns, point_map.views)
            for index, each in enumerate(objects)
            if each.session == name and each.returns is not None
        }
        floor = _find_floor(point_map, {index: objects[index] for index in sights})
        movers = _find_movers(point_map, sights) if config.movers == "drop" else set()
        rejected |= floor | movers | {index for index in sights.keys() - movers if sights[index].is_double()}
    return [each for index, each in enumerate(objects) if index not in rejected]


def is_floor(returns_odom: Float64Array, around_odom: Float64Array) -> bool:
    """Return whether (N, 3) returns of an object are a level sheet, no higher than the floor of a (Q, 3) map around.

    Floor is what lies lowest in each column of the map: what stands beside the object tells nothing of it.
    """
    if not is_level_sheet(returns_odom, _SHEET_M):
        return False
    low, high = returns_odom.min(axis=0) - _AROUND_M, returns_odom.max(axis=0) + _AROUND_M
    around = around_odom[((around_odom > low) & (around_odom < high)).all(axis=1)]
    around = around[np.isfinite(cKDTree(returns_odom[:, :2]).query(around[:, :2], distance_upper_bound=_AROUND_M)[0])]
    if len(around) < _LEAST_AROUND:
        return False
    centre, normal = fit_plane(returns_odom)
    over_m = (around - centre) @ normal
    _, column = np.unique(cell_keys(around * (1.0, 1.0, 0.0), _COLUMN_M), return_inverse=True)
    lowest_m = np.full(column.max() + 1, np.inf)
    np.minimum.at(lowest_m, column, over_m)
    return bool(np.median(over_m[over_m < lowest_m[column] + _SHEET_M]) > -_ABOVE_M)


def _find_floor(point_map: PointMap, objects: Mapping[int, PointGroup]) -> set[int]:
    """Return the objects of a session that are bare floor."""
    is_rest = np.ones(len(point_map.points), dtype=np.bool_)
    for each in objects.values():
        is_rest[each.indices] = False
    rest = point_map.points[is_rest]
    return {
        index
        for index, each in objects.items()
        if each.returns is not None and is_floor(point_map.positions_of(each.returns), rest)
    }


def _find_movers(point_map: PointMap, sights: Mapping[int, Sight]) -> set[int]:
    """Return the objects of a session that are people, machines, or parts of what moved."""
    left = {index for index, sight in sights.items() if sight.has_left()}
    gone = _index([sights[index].stamped for index in sorted(left)])
    points, scans = point_map.mover_points, point_map.mover_scans
    dropped = _index([] if points is None or scans is None else [_stamp(points, scans)])
    return left | {
        index
        for index in sights.keys() - left
        if (each := sights[index]).is_beside(gone)
        or (each.is_seen_through() and each.is_beside(dropped))
        or each.is_passing()
        or each.is_person()
    }


def _index(stamped: Sequence[Float64Array]) -> cKDTree:
    return cKDTree(np.concatenate([np.zeros((0, 4)), *stamped]))


def _stamp(points: Float64Array | Float32Array, scans: Int64Array | Int32Array) -> Float64Array:
    """Return (N, 4) places and scans of returns; those of different scans are not near to one another."""
    return np.column_stack([points, 2 * _BESIDE_M * scans])


class Sight:
    """How the session of an object saw it."""

    def __init__(self, point_map: PointMap, returns: Int64Array, views: KeyframeViews) -> None:
        """Look the (N,) returns of an object up in its map, which has range images of its keyframes."""
        self._odom_T_sensor, self._views = point_map.odom_T_sensor, views
        self._keyframe_scans = point_map.keyframe_scans
        self._points, self._scans = point_map.positions_of(returns), point_map.scans_of(returns)
        self._path_m = travelled_m(self._odom_T_sensor)
        self._cells, _ = cell_means(self._points, _CELL_M)
        self._seen = np.unique(self._scans)
        self._looks = look_by_keyframe(self._cells, views)
        # way from each scan to the nearest that hit it
        self._off_m = np.asarray(cKDTree(self._path_m[self._seen, None]).query(self._path_m[:, None])[0])

    @property
    def stamped(self) -> Float64Array:
        """(N, 4) places and scans of its returns."""
        return _stamp(self._points, self._scans)

    def is_double(self) -> bool:
        """Return whether it is a wall that is in the map twice, after drift or because it was seen from far away.

        Its session then sees through it, too: over `_DOUBLED` times as often as keyframes hit it, or over
        `_DOUBLED_AFAR` times if most of the returns, weighted by path length, were seen from over 15 m.
        """
        is_far = np.linalg.norm(self._points - self._odom_T_sensor[self._scans, :3, 3], axis=1) > REACH_M
        # weighted by path length, because the scans of a robot at rest are redundant
        way_m = np.diff(self._path_m, prepend=0.0)[self._scans]
        is_afar = way_m[is_far].sum() > way_m[~is_far].sum()
        return bool(self._looks.n_through.sum() > (_DOUBLED_AFAR if is_afar else _DOUBLED) * self._looks.n_hit.sum())

    def is_beside(self, movers: cKDTree) -> bool:
        """Return whether most of its returns lie beside movers, stamped returns, in the same scans."""
        return bool(np.isfinite(movers.query(self.stamped, distance_upper_bound=_BESIDE_M)[0]).mean() > _MOST)

    def is_seen_through(self) -> bool:
        """Return whether keyframes around those that hit it saw through it, as through a part of what moves."""
        is_around = self._off_m[self._keyframe_scans] <= REACH_M
        return bool(self._looks.n_through[is_around].sum() > _PART * self._looks.n_hit[is_around].sum())

    def is_passing(self) -> bool:
        """Return whether it passed: few scans hit it, or keyframes around those that hit it saw through it."""
        return is_fleeting(self._odom_T_sensor, self._seen) or self._is_on_its_way()

    def _is_on_its_way(self) -> bool:
        looks, at_keyframes_m = self._looks, self._off_m[self._keyframe_scans]
        is_around = at_keyframes_m <= REACH_M
        if looks.n_pixel_through[is_around].sum() > _PALE * looks.n_pixel_hit[is_around].sum():
            return True
        is_near = at_keyframes_m <= _PASS_M
        n_through, n_hit = looks.n_through[is_near].sum(), looks.n_hit[is_near].sum()
        # weighted by path length, as in `is_double`, but for a robot that never moved
        way_m = np.diff(self._path_m, prepend=0.0) if self._path_m[-1] > 0 else np.ones(len(self._path_m))
        is_seldom = way_m[self._seen].sum() < _SELDOM * way_m[self._off_m <= _PASS_M].sum()
        return bool(n_through > (_SELDOM_ON_ITS_WAY if is_seldom else _ON_ITS_WAY) * n_hit)

    def is_person(self) -> bool:
        """Return whether it has the shape of a person."""
        return is_person(self._points)

    def has_left(self) -> bool:
        """Return whether it came or left while the robot was beyond the reach of range images for small things."""
        places, _ = cell_means(self._points, _FAR_CELL_M)
        size_m, height_m = upright_box(self._cells)[1][[0, 2]]
        reach_m = min(size_m / PIXEL_WIDTH_RAD, height_m / PIXEL_HEIGHT_RAD, _FARTHEST_M)
        if reach_m <= REACH_M:
            return False
        looks = look_by_keyframe(places, self._views, reach_m)
        at_m = self._path_m[self._keyframe_scans]
        hits_m = at_m[looks.n_hit > _HIT_SHARE * len(places)]
        if len(hits_m) == 0:
            return False
        keyframes = self._odom_T_sensor[self._keyframe_scans, :3, 3]
        is_far = np.linalg.norm(keyframes - places.mean(axis=0), axis=1) > REACH_M
        is_ahead = (at_m < hits_m[0]) & (at_m > hits_m[0] - _GONE_WAY_M)
        is_behind = (at_m > hits_m[-1]) & (at_m < hits_m[-1] + _GONE_WAY_M)
        n_through = max(looks.n_through[is_far & each].sum() for each in (is_ahead, is_behind))
        return bool(n_through > _GONE * len(places))


def is_fleeting(odom_T_sensor: Float64Array, seen: Int64Array) -> bool:
    """Return whether the (N,) sorted scans are one or two of the session's (S, 4, 4), with others around them."""
    around = odom_T_sensor[max(seen[0] - 1, 0) : seen[-1] + 2]
    has_others = len(seen) <= _FLEETING_SCANS and len(around) > len(seen)
    return has_others and bool(travelled_m(around)[-1] <= _FLEETING_M)
