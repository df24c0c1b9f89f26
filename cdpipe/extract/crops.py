"""Crop spheres from both merged maps, in the map frame; only the cropped after points are transformed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.geometry.grid_index import GridIndex, is_in_sphere
from cdpipe.model.types import MergedMaps, SessionName

SESSIONS: tuple[SessionName, SessionName] = ("before", "after")
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
        self._merged = merged
        self._indices = {name: GridIndex(merged.map_of(name).points) for name in SESSIONS}
        self._margin_m = margin_m

    def around(self, centre_map: Float64Array, radius_m: float) -> dict[SessionName, Sphere]:
        """Return the spheres of both sessions around a (3,) centre, map frame."""
        spheres: dict[SessionName, Sphere] = {}
        for name in SESSIONS:
            indices, points = self.crop(name, centre_map, radius_m + self._margin_m)
            spheres[name] = Sphere(indices, points, is_in_sphere(points, centre_map, radius_m))
        return spheres

    def near(self, session: SessionName, points_map: Float64Array, reach_m: float) -> Int64Array:
        """Return the indices of the map points of a session within `reach_m` of any of (N, 3) points, map frame."""
        centre = (points_map.min(axis=0) + points_map.max(axis=0)) / 2
        radius_m = float(np.linalg.norm(points_map - centre, axis=1).max()) + reach_m
        indices, points = self.crop(session, centre, radius_m)
        distance_m, _ = cKDTree(points_map).query(points, distance_upper_bound=reach_m)
        return indices[np.isfinite(distance_m)]

    def crop(self, session: SessionName, centre_map: Float64Array, reach_m: float) -> tuple[Int64Array, Float64Array]:
        """Return the map points of a session within `reach_m` of a (3,) centre, and their (N, 3) map positions."""
        indices, points = self.crop_roughly(session, centre_map, reach_m)
        if session == "before" or self._merged.alignment.is_rigid:
            return indices, points
        is_near = is_in_sphere(points, centre_map, reach_m)
        return indices[is_near], points.compress(is_near, axis=0)

    def crop_roughly(
        self, session: SessionName, centre_map: Float64Array, reach_m: float
    ) -> tuple[Int64Array, Float64Array]:
        """Return what `crop` returns; with a local alignment also some points up to `_BEND_M` beyond the sphere."""
        if session == "after" and not self._merged.alignment.is_rigid:
            reach_m += _BEND_M  # a sphere of the map frame is slightly deformed in the after odom frame
        centre_odom = self._merged.to_odom(session, centre_map[None])[0]
        indices = self._indices[session].crop(centre_odom, reach_m)
        return indices, self._merged.to_map(session, self._merged.map_of(session).points.take(indices, axis=0))
