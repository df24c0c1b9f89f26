"""How far the rock moved between two merged sessions. This module alone defines the order of the steps.

1. The near returns of each session are averaged in cells of 0.05 m (`cells`).
2. Places on the before surface get a normal and a roughness (`places`).
3. At each place the offset between both surfaces is measured along the normal (`offsets`).
4. The rigid motions that most of the offsets share are the alignment's (`motions`). They are taken off the scans of the
   after session, place by place of the sensor, and the offsets are measured again.
5. The level of detection adds up the error of the means, the covariance of those motions, and the roughness.
6. Objects are told from rock (`rock_or_object`), and the displacement of objects is left out.
7. Neighbouring places beyond their level are regions (`regions`). The bottom of hollows may be hidden (`hollows`).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.core.plugins import require_extra
from cdpipe.core.threads import allowed_threads
from cdpipe.model.config import PipelineConfig, SurfaceConfig
from cdpipe.model.report import MAX_DISPLACEMENT_M, ChangedObject, SurfaceField
from cdpipe.model.types import MergedMaps
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells, near_returns
from cdpipe.surface.hollows import is_hollow, measure_hollows
from cdpipe.surface.method import Z95, Measured, Method
from cdpipe.surface.motions import PathMotions, fit_motions
from cdpipe.surface.offsets import Offsets, measure_offsets
from cdpipe.surface.places import SurfacePlaces, choose_places
from cdpipe.surface.regions import group_regions
from cdpipe.surface.rivals.c2c import measure_c2c
from cdpipe.surface.rivals.c2m import measure_c2m
from cdpipe.surface.rivals.m3c2 import measure_m3c2, measure_m3c2_ep
from cdpipe.surface.rivals.unrolled import measure_unrolled
from cdpipe.surface.rock_or_object import split_rock
from cdpipe.surface.unrolled import unroll

# Rougher or less flat places (edges, pipes, bolts) do not tell the motion of the alignment.
# Nor do places that moved farther than a merge is ever off.
_FLAT, _SMOOTH_M, _NEAR_M = 0.25, 0.03, 0.1
# Places left so many standard deviations off have moved, and tell nothing about the scans.
_TO_SIGMA, _OUTLIER = 1.4826, 4.0
# Every fourth place tells which of them moved. The motions are fitted to thousands of places.
_EVERY = 4
# About so many returns of the after session tell the motions of its scans, each within that way of a place.
_SAMPLE, _ON_PLACE_M, _SCAN_WINDOW_M = 400_000, 0.2, 4.0
# Standard deviation of the tilt of scans that is left. It moves places by their distance from the path, which counts
# where they are farther than the walls that the motions are fitted to, as beyond the ends of the path.
_TILT_RAD, _CLOSE_M = 2e-3, 4.0
# The variance of a mean from four folds is noisy: that of a place is the mean over its neighbours.
_NEIGHBOURS = 8
# Where less than that share of the occupied voxels has a displacement, and cells lie farther apart than that share of
# a radius, the map is too thin: it needs a radius of that many times the distance. So many cells tell it.
_MOST, _THIN, _WIDE, _SPACING_SAMPLE = 0.5, 0.6, 2.0, 20_000
# What each method averages or joins cells over, beside the radius of the normals of the places, which is of all.
_WIDTHS = MappingProxyType({
    "planes": ("surface.radius_m",), "m3c2": ("m3c2.cylinder_m",), "m3c2-ep": ("m3c2.cylinder_m",), "c2c": (),
    "c2m": ("surface.mesh_m",), "unrolled": ("surface.raster_m",),
})  # fmt: skip
# Least share of the roughness that both spheres do not share, as standard deviation, and the least error of a mean.
_ROUGHNESS, _LEAST_M = 0.18, 0.0004
# Two means over few cells of one rough surface differ by that share of what they would if each session drew its cells
# from a spread as wide. Where the cells lie on no single surface, as on wire mesh and the rock behind it, each does:
# it sees its own share of the wire, over whole patches. Places less flat than this are of that kind.
_OF_ONE_SURFACE, _OF_SEVERAL, _SEVERAL_FLATNESS = 0.6, 1.2, 0.15


def measure_surface(
    merged: MergedMaps, objects: tuple[ChangedObject, ...], config: PipelineConfig
) -> tuple[SurfaceField, BoolArray, float]:
    """Return the displacement of the rock, which of the (O,) objects are rock, and the seconds that it took.

    Args:
        merged: Both maps and their alignment.
        objects: Objects that came or went, map frame.
        config: `surface` is used, and the settings of the rival that it names.
    """
    start = time.perf_counter()
    settings = config.surface
    returns = near_returns(merged, "before")
    cells = make_cells(returns)
    places = choose_places(cells, returns, settings.spacing_m, settings.normal_m)
    del returns  # as much memory as all the rest
    chainage_m, angle_deg, _ = unroll(places.points, merged.before.odom_T_sensor)
    after = near_returns(merged, "after")
    measured = load_method(settings.method)(cells, after, places, chainage_m, config)
    measured = _within_search(measured)
    _warn_of_thin_maps((cells, measured.after), measured.displacement_m, config)
    is_rock, is_of_object = split_rock(objects, places, measured.along_m, measured.level_m)
    along_m, displacement_m = (
        np.where(is_of_object, np.nan, values) for values in (measured.along_m, measured.displacement_m)
    )
    region, regions = group_regions(
        places, along_m, measured.level_m, settings.spacing_m, settings.least_m, settings.least_area_m2,
        shared_m=measured.shared_m,
    )  # fmt: skip
    if any(is_hollow(each) for each in regions):
        is_hidden, laid = np.isnan(measured.along_m), measured.after or make_cells(after)
        region, regions = measure_hollows(regions, region, cells, places, is_hidden, laid)
    field = SurfaceField(
        places.points, places.normals, displacement_m, measured.level_m, region, regions, chainage_m, angle_deg
    )
    return field, is_rock, time.perf_counter() - start


def _warn_of_thin_maps(
    sessions: tuple[SurfaceCells, SurfaceCells | None], displacement_m: Float64Array, config: PipelineConfig
) -> None:
    """Warn where most of the before surface has no displacement, as the method finds too few cells of a thin map."""
    n_occupied = len(np.unique(cell_keys(sessions[0].points, config.surface.spacing_m)))
    if np.count_nonzero(np.isfinite(displacement_m)) >= _MOST * n_occupied:
        return
    apart_m = max(_spacing_m(each) for each in sessions if each is not None)
    widths_m = {name: _value(config, name) for name in (*_WIDTHS[config.surface.method], "surface.normal_m")}
    if apart_m > _THIN * min(widths_m.values()):
        wide_m = np.ceil(20 * _WIDE * apart_m) / 20
        narrow = {name: value for name, value in widths_m.items() if value < wide_m}
        told = " and ".join(f"{name} = {value:g}" for name, value in narrow.items())
        text = (
            f"most of the rock has no displacement: points are {apart_m:.2f} m apart, and {told} "
            f"hold{'s' * (len(narrow) == 1)} too few: {' '.join(f'--set {name}={wide_m:g}' for name in narrow)}"
        )
        warnings.warn(text, InputWarning, stacklevel=2)


def _value(config: PipelineConfig, name: str) -> float:
    """Return the value of a setting that is named by its section and itself."""
    section, _, own = name.partition(".")
    return float(getattr(getattr(config, section), own))


def _spacing_m(cells: SurfaceCells) -> float:
    """Return the median distance of a cell to its nearest neighbour, metres; NaN of fewer than two cells."""
    some = cells.points[:: max(len(cells.points) // _SPACING_SAMPLE, 1)]
    found = cells.tree.query(some, k=[2], workers=allowed_threads())[0] if len(some) > 1 else np.full(1, np.nan)
    return float(np.median(found))


def _within_search(measured: Measured) -> Measured:
    """Return what was measured, NaN beyond the largest displacement that an answer may state, and where infinite."""
    is_known = (np.abs(measured.displacement_m) <= MAX_DISPLACEMENT_M) & (
        np.abs(measured.along_m) <= MAX_DISPLACEMENT_M
    )
    displacement_m, along_m = (
        np.where(is_known, values, np.nan) for values in (measured.displacement_m, measured.along_m)
    )
    level_m = np.where(np.isfinite(measured.level_m), measured.level_m, np.nan)
    return replace(measured, displacement_m=displacement_m, along_m=along_m, level_m=level_m)


def measure_planes(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, config: PipelineConfig
) -> Measured:
    """Measure the displacement by local planes, less what the alignment absorbed: our method."""
    settings = config.surface
    after = after.without(_fit_scans(before, after, places, chainage_m, settings))
    laid = make_cells(after)
    found = measure_offsets(before, laid, places, settings.radius_m)
    motions = fit_motions(places.points, places.normals, _trust(places, found), chainage_m, settings.window_m)
    explained_m, alignment_m2 = motions.along(places.points, places.normals, chainage_m)
    noise_m2 = _smooth_variance(places.points, found.variance_m2)
    rough_m2, shared_rough_m2 = _sample_roughness(places, found.sampling)
    tilt_m2 = (_TILT_RAD * np.maximum(places.seen_from_m - _CLOSE_M, 0.0)) ** 2
    shared_m2 = alignment_m2 + tilt_m2
    own_m2 = noise_m2 + rough_m2 + shared_m2 + _LEAST_M**2
    level_m, shared_m = (Z95 * np.sqrt(each) for each in (own_m2, shared_m2 + shared_rough_m2))
    return Measured(found.nearest_m - explained_m, found.along_m - explained_m, level_m, shared_m, laid)


def _sample_roughness(places: SurfacePlaces, sampling: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the (Q,) variance of the difference of two means by the roughness, and the part that neighbours share.

    The (Q,) `sampling` is the sum of the inverse numbers of cells, NaN where there are too few.
    """
    is_several = places.flatness > _SEVERAL_FLATNESS
    drawn = np.where(is_several, _OF_SEVERAL, _OF_ONE_SURFACE) ** 2 * np.nan_to_num(sampling)
    rough_m2 = places.roughness_m**2
    return rough_m2 * np.maximum(drawn, _ROUGHNESS**2), rough_m2 * np.where(is_several, drawn, 0.0)


def _trust(places: SurfacePlaces, found: Offsets) -> Float64Array:
    """Return the (Q,) offsets of flat places that tell the motion of the alignment, NaN elsewhere."""
    is_told = (places.flatness < _FLAT) & (places.roughness_m < _SMOOTH_M) & (np.abs(found.along_m) < _NEAR_M)
    return np.where(is_told, found.along_m, np.nan)


def _is_still(rest_m: Float64Array) -> BoolArray:
    """Mark the places at which the motions leave no more than their errors do."""
    sigma_m = _TO_SIGMA * float(np.nanmedian(np.abs(rest_m))) if np.isfinite(rest_m).any() else 0.0
    return np.asarray(np.abs(rest_m) <= _OUTLIER * sigma_m)


def _fit_scans(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, settings: SurfaceConfig
) -> PathMotions:
    """Return the motions of the after scans, by path position of the sensor, that lay their returns on still places."""
    some = np.arange(0, len(places.points), _EVERY)
    places = places.take(some)
    found = measure_offsets(before, make_cells(after, with_folds=False), places, settings.radius_m, with_variance=False)
    told_m = _trust(places, found)
    motions = fit_motions(places.points, places.normals, told_m, chainage_m[some], settings.window_m)
    is_still = _is_still(told_m - motions.along(places.points, places.normals, chainage_m[some])[0])
    still = np.flatnonzero(is_still)
    sample = np.arange(0, len(after.points), max(len(after.points) // _SAMPLE, 1))
    points = after.points[sample]
    if len(still) == 0:
        return fit_motions(points[:0], points[:0], points[:0, 0], points[:0, 0], _SCAN_WINDOW_M)
    nearest = cKDTree(places.points[still]).query(points, distance_upper_bound=_ON_PLACE_M, workers=allowed_threads())
    on = np.flatnonzero(np.isfinite(nearest[0]))
    place = still[np.asarray(nearest[1], dtype=np.int64)[on]]
    normals = places.normals[place]
    along_m = np.einsum("ij,ij->i", points[on] - places.points[place], normals) - found.own_m[place]
    return fit_motions(points[on], normals, along_m, after.path_m[sample[on]], _SCAN_WINDOW_M)


# What `surface.method` names. A rival that needs an extra has the name of the extra beside it.
_METHODS: Mapping[str, Method] = MappingProxyType({
    "planes": measure_planes, "m3c2": measure_m3c2, "m3c2-ep": measure_m3c2_ep, "c2c": measure_c2c,
    "c2m": measure_c2m, "unrolled": measure_unrolled,
})  # fmt: skip
_EXTRAS = MappingProxyType({"m3c2": "m3c2", "m3c2-ep": "m3c2"})


def require_method(name: str) -> None:
    """Raise `InputError` where `surface.method` names a rival whose extra is not installed."""
    if name in _EXTRAS:
        require_extra(_EXTRAS[name], f"surface.method = {name}")


def load_method(name: str) -> Method:
    """Return what measures the displacement: ours or a rival.

    Raises:
        InputError: The extra of the rival is not installed.
        KeyError: Nothing has this name. `none` measures nothing.
    """
    require_method(name)
    return _METHODS[name]


def _smooth_variance(points: Float64Array, variance_m2: Float64Array) -> Float64Array:
    """Return the (Q,) mean variance of each place and its neighbours that have one."""
    known = np.flatnonzero(np.isfinite(variance_m2))
    if len(known) == 0:
        return np.full(len(points), np.nan)
    tree, k = cKDTree(points[known]), min(_NEIGHBOURS, len(known))
    index = tree.query(points, k=k, workers=allowed_threads())[1].reshape(len(points), -1)
    return np.asarray(variance_m2[known][index].mean(axis=1))
