"""Crop spheres from both merged maps, in the map frame; only the cropped after points are transformed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.grid_index import GridIndex, is_in_sphere
from cdpipe.model.types import MergedMaps, SessionName

DIRECTIONS: tuple[tuple[SessionName, SessionName], ...] = (("after", "before"), ("before", "after"))
# Margin for an alignment that varies inside a sphere: 1 % drift moves a point 10 m from the centre by 0.1 m.
_BEND_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Sphere:
    """Map points of one session in a sphere and its margin.

    Attributes:
        indices: (N,) map points.
        points: (N, 3) their positions, map frame, metres.
        is_inside: (N,) whether a point is in the sphere; the others are in the margin.
    """

    indices: Int64Array
    points: Float64Array
    is_inside: BoolArray

    @property
    def inside(self) -> tuple[Int64Array, Float64Array]:
        """The indices and positions of the points in the sphere, without the margin."""
        chosen = np.flatnonzero(self.is_inside)
        return self.indices[chosen], self.points.take(chosen, axis=0)


class Crops:
    """Crops spheres with a margin from two merged maps."""

    def __init__(self, merged: MergedMaps, margin_m: float) -> None:
        self._alignment = merged.alignment
        self._points = {"before": merged.before.points, "after": merged.after.points}
        self._indices = {name: GridIndex(points) for name, points in self._points.items()}
        self._margin_m = margin_m

    def around(self, centre_map: Float64Array, radius_m: float) -> dict[SessionName, Sphere]:
        """Return the spheres of both sessions around a (3,) centre, map frame."""
        return {name: self._sphere(name, centre_map, radius_m) for name in ("before", "after")}

    def near(self, session: SessionName, points_map: Float64Array, reach_m: float) -> Int64Array:
        """Return the indices of the map points of a session within `reach_m` of any of (N, 3) points, map frame."""
        centre = (points_map.min(axis=0) + points_map.max(axis=0)) / 2
        radius_m = float(np.linalg.norm(points_map - centre, axis=1).max()) + reach_m
        indices, points = self._crop(session, centre, radius_m)
        distance_m, _ = cKDTree(points_map).query(points, distance_upper_bound=reach_m)
        return indices[np.isfinite(distance_m)]

    def points_map(self, session: SessionName, indices: Int64Array) -> Float64Array:
        """Return the (N, 3) positions of the given map points of a session, map frame, metres."""
        points = self._points[session].take(indices, axis=0)
        return points if session == "before" else self._alignment.to_map(points)

    def _sphere(self, session: SessionName, centre_map: Float64Array, radius_m: float) -> Sphere:
        indices, points = self._crop(session, centre_map, radius_m + self._margin_m)
        return Sphere(indices, points, is_in_sphere(points, centre_map, radius_m))

    def _crop(self, session: SessionName, centre_map: Float64Array, reach_m: float) -> tuple[Int64Array, Float64Array]:
        if session == "before":
            indices = self._indices["before"].crop(centre_map, reach_m)
            return indices, self._points["before"].take(indices, axis=0)
        centre_odom = self._alignment.to_odom(centre_map[None])[0]
        if self._alignment.is_rigid:
            indices = self._indices["after"].crop(centre_odom, reach_m)
            return indices, self._alignment.to_map(self._points["after"].take(indices, axis=0))
        # a sphere of the map frame is slightly deformed in the after odom frame
        indices = self._indices["after"].crop(centre_odom, reach_m + _BEND_M)
        points = self._alignment.to_map(self._points["after"].take(indices, axis=0))
        is_near = is_in_sphere(points, centre_map, reach_m)
        return indices[is_near], points.compress(is_near, axis=0)
