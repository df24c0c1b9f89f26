"""The surface rule: an object is changed if it stands out of the other session's surface in observed free space.

1. In every reported sphere, map points off the planes of the other map are candidates (`find_candidates`). Connected
   candidates form a site.
2. Around each site the returns of both sessions are compared in cells of 0.05 and 0.1 m (`compare_site`). Objects grow
   from cells that are clear of the surface and were seen through, down to the noise of the surfaces (`grow_objects`).

A place that the other session did not observe is unknown and no change.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.merge.registration import Surface, search_nearest
from cdpipe.model.config import ExtractConfig

# Point-to-plane distance of a candidate: below the height of the lowest objects, above the error of a map point.
_COARSE_M = 0.08
_MIN_CANDIDATES = 3  # `_are_three_together` is made for this number
# Candidates closer than this form one site; the site includes everything within this distance of them.
SITE_M = 0.5
# Margin of the other session's surface around a site.
RIM_M = 0.3
CELL_M = 0.05
SURFACE_CELL_M = 0.1
_LINK_M = 0.15
_TABLE_CELL_M = 0.25
# Radius in which the plane of a map point, and of a cell of returns, is valid.
_COARSE_PLANE_M, _PLANE_M = 0.4, 0.25
# Near-coplanar points beyond the edge of the map are gaps, not changes: largest ratio of plane to point distance.
_GRAZING = 0.2
_MIN_SURFACE = 20
_NOISE_FACTOR = 5.0
_SEED_FACTOR = 2.5
_MAX_BORDER = 5.0
# Largest distance of an object's foot, which no ray can pass, from its cells in free space.
_FOOT_M = 0.3
# Solid parts of a group that are farther apart are objects of their own. Mixed returns are one or two to a cell, and
# a surface near the sensor has ten; both are looked at within 0.2 m.
_APART_M = 0.3
_FULL_RETURNS, _DENSE_M = 3, 0.2
# Where two parts meet, cells within `_SEAM_M` of the other part hold mixed returns: fewer to a cell than the parts do,
# this share at most. A surface that the sensor sampled thinly has no such seam.
_SEAM_M, _SEAM_SHARE = 0.1, 0.75
# Least number of scans with a grazing ray through a cell of a low object.
MIN_SCANS_PAST = 3
# Least size of a low object: 0.25 m^2 in cells of 0.05 m. As so many cells must agree, those on a floor may be nearer
# to it than seeds of other objects: as far as candidates, or this many times the noise.
_MIN_LOW_CELLS = 100
_LOW_FACTOR = 8.0
_LEVEL = np.cos(np.deg2rad(30.0))  # of the normals of a floor; muck lies at 34 degrees and more


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """The cells around candidates of one session, and their distance to the other session's surface.

    Attributes:
        points: (N, 3) mean of the returns of each occupied cell, map frame, metres.
        cell_of_return: (M,) cell of each return.
        distance_m: (N,) distance of each cell to the other session's surface, metres; inf without a surface.
        is_on_floor: (N,) whether the surface nearest to it is a floor below it.
    """

    points: Float64Array
    cell_of_return: Int64Array
    distance_m: Float64Array
    is_on_floor: BoolArray


def distances_m(points: Float64Array, surface: Surface, plane_m: float) -> tuple[Float64Array, BoolArray]:
    """Return the (N,) distances of (N, 3) points to a surface, metres, and whether they are above a floor.

    It is the point-to-plane distance if the nearest surface point is within `plane_m` or the point is near-coplanar;
    otherwise it is the distance to the nearest surface point.
    """
    chosen, nearest_m = find_nearest(points, surface)
    offsets, normals = points - surface.points.take(chosen, axis=0), surface.normals.take(chosen, axis=0)
    along = np.einsum("ij,ij->i", offsets, normals)
    off_plane_m = np.abs(along)
    is_on_plane = (nearest_m < plane_m) | (off_plane_m < _GRAZING * nearest_m)
    is_on_floor = (np.abs(normals[:, 2]) > _LEVEL) & (along * normals[:, 2] > 0)
    return np.asarray(np.where(is_on_plane, off_plane_m, nearest_m)), is_on_floor


def find_nearest(points: Float64Array, surface: Surface) -> tuple[Int64Array, Float64Array]:
    """Return the (N,) index of the surface point nearest to each of (N, 3) points, and its distance, metres."""
    found, squared_m2 = search_nearest(surface.tree, points)
    return found, np.sqrt(squared_m2)


class PlaneTable:
    """One plane of a surface per grid cell: a fast first test, because most points lie on the plane of their cell."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self._low = surface.points.min(axis=0)
        cells = self._cells(surface.points)
        self._shape = cells.max(axis=1) + 1
        self._table = np.full(int(self._shape.prod()), -1, dtype=np.int32)
        self._table[self._flat(cells)] = np.arange(len(surface.points), dtype=np.int32)

    def distances_m(self, points: Float64Array) -> Float64Array:
        """Return the (N,) distances of (N, 3) points to the plane of their cell, metres; inf without a plane."""
        cells = self._cells(points)
        is_inside = ((cells >= 0) & (cells < self._shape[:, None])).all(axis=0)
        found = np.full(len(points), -1, dtype=np.int32)
        found[is_inside] = self._table.take(self._flat(cells[:, is_inside]))
        offsets = points - self.surface.points.take(found, axis=0)
        along = np.abs(np.einsum("ij,ij->i", offsets, self.surface.normals.take(found, axis=0)))
        return np.asarray(np.where(found >= 0, along, np.inf))

    def _cells(self, points: Float64Array) -> Int64Array:
        return np.stack([(points[:, axis] - self._low[axis]) // _TABLE_CELL_M for axis in range(3)]).astype(np.int64)

    def _flat(self, cells: Int64Array) -> Int64Array:
        return np.asarray((cells[0] * self._shape[1] + cells[1]) * self._shape[2] + cells[2])


def find_candidates(points: Float64Array, table: PlaneTable) -> tuple[Int64Array, float]:
    """Return the map points (N, 3) off the other map's surface, in groups of three or more.

    Returns:
        The indices, and the median distance of all points to the surface, which is the noise of the two surfaces.
    """
    distance_m = table.distances_m(points)
    doubtful = np.flatnonzero(distance_m > _COARSE_M)
    distance_m[doubtful], _ = distances_m(points.take(doubtful, axis=0), table.surface, _COARSE_PLANE_M)
    standing = np.flatnonzero(distance_m > _COARSE_M)
    return standing[_are_three_together(points[standing])], float(np.median(distance_m))


def _are_three_together(points: Float64Array) -> BoolArray:
    """Mark the (N, 3) points in groups of three or more, as `label_groups` finds them, but faster.

    Such a point has two neighbours, or a neighbour with two.
    """
    is_together = np.zeros(len(points), dtype=np.bool_)
    if len(points) < _MIN_CANDIDATES:
        return is_together
    one, other = cKDTree(points).query_pairs(SITE_M, output_type="ndarray").T
    has_two = np.bincount(one, minlength=len(points)) + np.bincount(other, minlength=len(points)) >= 2
    is_strong = has_two[one] | has_two[other]
    is_together[one[is_strong]] = True
    is_together[other[is_strong]] = True
    return is_together


def compare_site(points: Float64Array, reference: Float64Array) -> Site:
    """Compare the (M, 3) returns around a site with the (R, 3) returns of the other session, map frame, metres."""
    means, cell_of_return = cell_means(points, CELL_M)
    unknown = np.zeros(len(means), dtype=np.bool_)
    if len(reference) == 0:
        return Site(means, cell_of_return, np.full(len(means), np.inf), unknown)
    surface_points, _ = cell_means(reference, SURFACE_CELL_M)
    if len(surface_points) < _MIN_SURFACE:
        return Site(means, cell_of_return, np.asarray(cKDTree(surface_points).query(means)[0]), unknown)
    return Site(means, cell_of_return, *distances_m(means, Surface(surface_points), _PLANE_M))


def measure_noise_m(site: Site, region_noise_m: float) -> float:
    """Return the noise at a site: the median distance of the cells on the other session's surface.

    The noise of the region, where other walls and sparser points may raise it, is the largest that is returned.
    """
    near_m = site.distance_m[site.distance_m < _COARSE_M]
    return min(region_noise_m, float(np.median(near_m))) if len(near_m) else region_noise_m


def grow_objects(site: Site, free_space_votes: Int64Array, noise_m: float, config: ExtractConfig) -> list[Int64Array]:
    """Return the cells of each object of a site.

    Connected cells form an object if they stand off the surface by more than the noise and were seen through, if at
    least `min_cells` of them are clear of the surface, and if on average `min_views` keyframes saw through them. The
    foot of an object is too close to floor and wall for a ray to pass behind it; cells near the object that stand off
    the surface are added to it. A group of several solid parts is several objects (`split_group`).

    Args:
        site: The cells.
        free_space_votes: (N,) keyframes of the other session that saw through each cell, minus those that hit it.
        noise_m: Median distance of the two surfaces in the region, metres.
        config: Thresholds.
    """
    stands_off, is_free = site.distance_m > border_threshold_m(noise_m, config), free_space_votes > 0
    core, foot = np.flatnonzero(stands_off & is_free), np.flatnonzero(stands_off & ~is_free)
    labels, sizes = label_groups(site.points[core], _LINK_M)
    n_views = np.bincount(labels, free_space_votes[core], len(sizes))
    is_seen = n_views >= config.min_views * sizes
    is_clear = site.distance_m > seed_threshold_m(noise_m, config)
    n_clear = np.bincount(labels[is_clear[core]], minlength=len(sizes))
    is_object = is_seen & (n_clear >= config.min_cells)
    return _split_objects(site, core[is_object[labels]], foot, is_clear, config.min_cells)


def split_group(points: Float64Array, n_returns: Int64Array, is_clear: BoolArray, min_cells: int) -> Int64Array:
    """Return the (N,) part of each cell of a connected group: all 0, or two parts and more that are objects apart.

    A beam that meets two surfaces returns from between them. Such returns link an object with what stands behind it,
    but seldom fall into the same cell. A cell is solid if it and most cells around it hold three returns or more. If
    solid cells lie in places `_APART_M` from one another, each with enough clear cells, every cell belongs to the
    nearest place. Places are of one part if the cells between them hold as many returns as the others.

    Args:
        points: (N, 3) cells, metres.
        n_returns: (N,) returns in each cell.
        is_clear: (N,) whether a cell is clear of the other session's surface.
        min_cells: Fewest clear cells of a part.
    """
    full = np.flatnonzero(n_returns >= _FULL_RETURNS)
    n_full, n_near = (
        cKDTree(each).query_ball_point(points[full], _DENSE_M, return_length=True) for each in (points[full], points)
    )
    solid = full[2 * n_full > n_near]
    means, cell_of_solid = cell_means(points[solid], SURFACE_CELL_M)
    labels, sizes = label_groups(means, _APART_M)
    labels = labels[cell_of_solid]
    n_clear = np.bincount(labels[is_clear[solid]], minlength=len(sizes))
    in_part = np.isin(labels, np.flatnonzero(n_clear >= min_cells))
    parts, part_of_solid = np.unique(labels[in_part], return_inverse=True)
    if len(parts) < 2:
        return np.zeros(len(points), dtype=np.int64)
    nearest = cKDTree(points[solid[in_part]]).query(points)[1]
    part = np.asarray(part_of_solid[nearest], dtype=np.int64)
    for one, other in combinations(range(len(parts)), 2):
        if not _is_seam_thin(points, n_returns, part == one, part == other):
            part[part == one] = other
    return np.unique(part, return_inverse=True)[1].astype(np.int64)


def _is_seam_thin(points: Float64Array, n_returns: Int64Array, is_one: BoolArray, is_other: BoolArray) -> bool:
    """Return whether the cells where two parts meet hold fewer returns than those of the parts do."""
    seam = [np.zeros(0, dtype=np.int64)]
    for own, there in ((is_one, is_other), (is_other, is_one)):
        gap_m = cKDTree(points[there]).query(points[own], distance_upper_bound=_SEAM_M)[0]
        seam.append(n_returns[own][np.isfinite(gap_m)])
    at_seam = np.concatenate(seam)
    if len(at_seam) == 0:
        return True
    return bool(at_seam.mean() <= _SEAM_SHARE * min(n_returns[is_one].mean(), n_returns[is_other].mean()))


def unassigned_cells(site: Site, taken: list[Int64Array], noise_m: float, config: ExtractConfig) -> Int64Array:
    """Return the cells that stand off the surface and are in no object; none if too few are clear of the surface."""
    is_left = site.distance_m > border_threshold_m(noise_m, config)
    is_left[np.concatenate([*taken, np.zeros(0, dtype=np.int64)])] = False
    left = np.flatnonzero(is_left)
    is_enough = np.count_nonzero(_is_clear_if_low(site, noise_m, config)[left]) >= _MIN_LOW_CELLS
    return left if is_enough else left[:0]


def add_low_objects(
    site: Site, left: Int64Array, is_passed: BoolArray, taken: list[Int64Array], noise_m: float, config: ExtractConfig
) -> list[Int64Array]:
    """Return the cells of each object of a site: those found so far, and what grazing rays reveal besides.

    Range images do not show free space above a low object. Grazing rays also pass through a surface that is slightly
    displaced, but there only some cells are clear of the surface; of a low object at least half are. A group that
    touches an object found so far is a part of it.

    Args:
        site: The cells.
        left: (L,) cells of the site to consider, from `unassigned_cells`.
        is_passed: (L,) whether enough scans of the other session have a grazing ray through each cell.
        taken: Cells of the objects found so far.
        noise_m: Median distance of the two surfaces in the region, metres.
        config: Thresholds.
    """
    is_clear = _is_clear_if_low(site, noise_m, config)
    core, foot = left[is_passed], left[~is_passed]
    labels, sizes = label_groups(site.points[core], _LINK_M)
    n_clear = np.bincount(labels[is_clear[core]], minlength=len(sizes))
    is_whole = (n_clear >= _MIN_LOW_CELLS) & (2 * n_clear >= sizes)
    objects = list(taken)
    if taken:
        of_cell = np.repeat(np.arange(len(taken)), [len(each) for each in taken])
        tree = cKDTree(site.points[np.concatenate(taken)])
        gaps_m, nearest = map(np.asarray, tree.query(site.points[core], distance_upper_bound=_FOOT_M))
        for label in np.flatnonzero(is_whole).tolist():
            members = np.flatnonzero(labels == label)
            closest = members[np.argmin(gaps_m[members])]
            if np.isfinite(gaps_m[closest]):
                touched = of_cell[nearest[closest]]
                objects[touched] = np.concatenate([objects[touched], core[members]])
                is_whole[label] = False
    return objects + _split_objects(site, core[is_whole[labels]], foot, is_clear, _MIN_LOW_CELLS)


def border_threshold_m(noise_m: float, config: ExtractConfig) -> float:
    """Return the distance from the surface above which a cell can belong to an object, metres."""
    return float(np.clip(_NOISE_FACTOR * noise_m, config.border_m, _MAX_BORDER * config.border_m))


def seed_threshold_m(noise_m: float, config: ExtractConfig) -> float:
    """Return the distance from the surface above which a cell is clear of it, metres."""
    return max(config.seed_m, _SEED_FACTOR * border_threshold_m(noise_m, config))


def _is_clear_if_low(site: Site, noise_m: float, config: ExtractConfig) -> BoolArray:
    """Mark the (N,) cells that are clear of the surface, if they are of a low object.

    Thin things lie on the floor; a wall that stands off by so little is one that odometry bent.
    """
    low_m, seed_m = max(_COARSE_M, _LOW_FACTOR * noise_m), seed_threshold_m(noise_m, config)
    return np.asarray(site.distance_m > np.where(site.is_on_floor, low_m, seed_m))


def _split_objects(
    site: Site, core: Int64Array, foot: Int64Array, is_clear: BoolArray, min_cells: int
) -> list[Int64Array]:
    """Return the cells of each object: its core, its foot, and what is nearest to it of the other foot cells.

    Core cells that foot cells join are of one object: what hides a place from the other session cuts no object in two.

    Args:
        site: The cells.
        core: (C,) cells of objects that were seen through.
        foot: (F,) other cells that stand off the surface; those near a core are a part of its object.
        is_clear: (N,) whether each cell of the site is clear of the other session's surface.
        min_cells: Fewest clear cells of an object.
    """
    if len(core) == 0:
        return []
    gap_m = cKDTree(site.points[core]).query(site.points[foot], distance_upper_bound=_FOOT_M)[0]
    cells = np.concatenate([core, foot[np.isfinite(gap_m)]])
    labels, sizes = label_groups(site.points[cells], _LINK_M)
    has_core = np.bincount(labels[: len(core)], minlength=len(sizes)) > 0
    n_returns = np.bincount(site.cell_of_return, minlength=len(site.points))
    objects = []
    for label in np.flatnonzero(has_core).tolist():
        own = cells[labels == label]
        part = split_group(site.points[own], n_returns[own], is_clear[own], min_cells)
        objects += [own[part == each] for each in range(part.max() + 1)]
    rest, of_object = cells[~has_core[labels]], np.repeat(np.arange(len(objects)), [len(each) for each in objects])
    nearest = of_object[cKDTree(site.points[np.concatenate(objects)]).query(site.points[rest])[1]]
    return [np.concatenate([each, rest[nearest == index]]) for index, each in enumerate(objects)]
