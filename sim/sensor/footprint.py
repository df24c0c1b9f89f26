"""The echo of a beam: of its central ray alone, or blended from several rays over its width as in the receiver."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from sim.geometry.bundles import Bundle
from sim.geometry.raycast import RayCaster
from sim.sensor.optics import DIVERGENCE_RAD, RETRO_FROM, WAIST_M, received_photons, reflected_share
from sim.sensor.rays import Rays

# Echoes nearer to one another than this blend into one. Ours, unverified: on the real revolution of `sim.sensor.optics`
# 18 % of the edge pixels lie between surfaces 1 to 2 m apart, 6 % between those 2 to 8 m apart; nearer ones are
# unmeasured.
PULSE_M = 1.0


@dataclass(frozen=True, slots=True)
class Limits:
    """The ranges at which the receiver listens, metres: an echo outside is not reported, and hides none within.

    Attributes:
        least_m: The least range.
        most_m: The greatest range.
    """

    least_m: float
    most_m: float

    def hold(self, range_m: Float32Array) -> BoolArray:
        """Return which ranges (...) lie within the limits."""
        return np.asarray((range_m >= self.least_m) & (range_m <= self.most_m))


EVERYWHERE = Limits(0.0, float("inf"))


@dataclass(frozen=True, slots=True, eq=False)
class Echo:
    """The light that returns to each pixel of a revolution, before the receiver measures it. All arrays (W, H).

    Attributes:
        range_m: float32 distance in the receiver, beam-origin offset included, 0 for a miss.
        photons: float32 expected photons, 0 for a miss.
        cosine: float32 of the incidence on `geom`, 0 for a miss.
        true_range_m: float32 distance to `geom` along the ray that met it, infinite for a miss.
        geom: int32 geom that the strongest ray met, -1 for a miss.
        owner: int32 owner of the geoms that reflected most of the light; any owner for a miss.
        owner_share: float32 share of the light that came from the geoms of `owner`; 1 for one ray per beam.
    """

    range_m: Float32Array
    photons: Float32Array
    cosine: Float32Array
    true_range_m: Float32Array
    geom: Int32Array
    owner: Int32Array
    owner_share: Float32Array


def central_echo(
    caster: RayCaster, reflectivity: Float32Array, rays: Rays, beam_origin_m: float, owners: Int32Array
) -> Echo:
    """Cast the middle of every beam at geoms of these reflectivities and owners, both (G,)."""
    distance_m, geom, cosine = caster.cast_columns(rays.origins, rays.directions)
    distance_m += np.float32(beam_origin_m)
    photons = received_photons(reflected_share(reflectivity, geom, cosine), distance_m)
    range_m = np.where(geom >= 0, distance_m, np.float32(0.0))
    return Echo(range_m, photons, cosine, distance_m, geom, owners[geom], np.ones_like(range_m))


def no_echo(like: Echo) -> Echo:
    """Return an echo of the same shape in which nothing comes back."""
    dark = np.zeros_like(like.range_m)
    return Echo(
        dark, dark, dark, np.full_like(dark, np.inf), np.full_like(like.geom, -1), like.owner, np.ones_like(dark)
    )


def outweighs(one: Echo, other: Echo, limits: Limits) -> BoolArray:
    """Return where (W, H) one echo is reported before another: it alone lies within the limits, or has more photons."""
    is_in, other_is_in = ((each.photons > 0) & limits.hold(each.range_m) for each in (one, other))
    return np.where(is_in == other_is_in, one.photons > other.photons, is_in)


def stronger_echo(one: Echo, other: Echo, limits: Limits) -> Echo:
    """Return the echo that outweighs the other, pixel by pixel; `one` where neither does."""
    return choose_echo(outweighs(other, one, limits), other, one)


def choose_echo(mask: BoolArray, chosen: Echo, other: Echo) -> Echo:
    """Return one echo where a mask (W, H) is true, and another elsewhere."""
    return Echo(*(np.where(mask, getattr(chosen, each.name), getattr(other, each.name)) for each in fields(Echo)))


def replace_pixels(echo: Echo, pixels: Int64Array, **values: npt.ArrayLike) -> Echo:
    """Return an echo with other values (M,) in some of its pixels, given by their flat numbers (M,)."""
    changed = {}
    for name, own in values.items():
        channel = getattr(echo, name).ravel().copy()
        channel[pixels] = own
        changed[name] = channel.reshape(echo.range_m.shape)
    return replace(echo, **changed)


@dataclass(frozen=True, slots=True, eq=False)
class BeamHits:
    """What the n rays of every beam of a revolution (W, H) met. All arrays (n, W * H).

    Attributes:
        ranges_m: float32 distance in the receiver, infinite for a miss.
        photons: float32 expected photons, 0 for a miss.
        geoms: int32 geom met, -1 for a miss.
        cosines: float32 of the incidence, 0 for a miss.
    """

    ranges_m: Float32Array
    photons: Float32Array
    geoms: Int32Array
    cosines: Float32Array


def cast_beams(
    caster: RayCaster,
    reflectivity: Float32Array,
    rays: Rays,
    beam_origin_m: float,
    sub_rays: Literal[7, 19],
    limits: Limits = EVERYWHERE,
) -> BeamHits:
    """Cast several rays over the width of every beam at geoms of these reflectivities (G,).

    Where a beam meets surfaces a pulse or more apart, within the limits and outside, rays that meet those outside
    become misses.
    """
    places, weights = sub_ray_pattern(sub_rays)
    ranges_m, geoms, cosines = caster.cast_bundles(rays.origins, rays.directions, beam_bundle(places))
    ranges_m += np.float32(beam_origin_m)
    photons = np.empty_like(ranges_m)
    for ray, weight in enumerate(weights):
        power = reflected_share(reflectivity, geoms[ray], cosines[ray])
        photons[ray] = np.float32(weight) * received_photons(power, ranges_m[ray])
    return _drop_unheard(BeamHits(ranges_m, photons, geoms, cosines), limits)


def _drop_unheard(hits: BeamHits, limits: Limits) -> BeamHits:
    """Let rays miss what lies outside the limits, in place, where `cast_beams` says so."""
    is_in = limits.hold(hits.ranges_m)
    is_out = np.isfinite(hits.ranges_m) & ~is_in
    if is_out.any():
        nearest_m = hits.ranges_m.min(axis=0)
        farthest_m = np.where(np.isinf(hits.ranges_m), np.float32(0.0), hits.ranges_m).max(axis=0)
        is_in &= hits.photons > 0
        is_out &= is_in.any(axis=0) & (farthest_m - nearest_m >= PULSE_M)
        hits.ranges_m[is_out], hits.photons[is_out], hits.geoms[is_out], hits.cosines[is_out] = np.inf, 0.0, -1, 0.0
    return hits


def spread_echo(
    caster: RayCaster,
    reflectivity: Float32Array,
    rays: Rays,
    beam_origin_m: float,
    owners: Int32Array,
    sub_rays: Literal[7, 19],
    limits: Limits = EVERYWHERE,
) -> Echo:
    """Cast several rays over the width of every beam and return the echo that they blend into (`blend_beams`)."""
    if caster.keeps_hits and not (reflectivity >= RETRO_FROM).any():
        from sim.sensor.blending import blend_on_device  # noqa: PLC0415 - an extra

        places, weights = sub_ray_pattern(sub_rays)
        told = cast(Any, caster), reflectivity, rays, beam_origin_m, owners, beam_bundle(places), weights, PULSE_M
        limits_m = limits.least_m, limits.most_m
        light, (geom, owner) = blend_on_device(*told, limits_m)
        range_m, photons, cosine, true_range_m, share = light
        return Echo(range_m, photons, cosine, true_range_m, geom, owner, share)
    hits = cast_beams(caster, reflectivity, rays, beam_origin_m, sub_rays, limits)
    return blend_beams(hits, owners, rays.directions.shape[:2])


def blend_beams(hits: BeamHits, owners: Int32Array, shape: tuple[int, ...]) -> Echo:
    """Blend the echoes of every beam's rays.

    Echoes of a pixel that follow one another by less than `PULSE_M` are one group; its range is the mean weighted with
    the photons. The strongest group is reported. Its geom is the one that the strongest ray of the group met.

    Args:
        hits: What the rays met.
        owners: (G,) owner of each geom.
        shape: (W, H).
    """
    range_m, strength, strongest = blend_echoes(hits.ranges_m, hits.photons)
    owner, owner_share = divide_light(owners[hits.geoms], hits.ranges_m, hits.photons)
    pixels = np.arange(len(strongest))
    return Echo(
        range_m.reshape(shape),
        strength.reshape(shape),
        hits.cosines[strongest, pixels].reshape(shape),
        hits.ranges_m[strongest, pixels].reshape(shape),
        hits.geoms[strongest, pixels].reshape(shape),
        owner.reshape(shape),
        owner_share.reshape(shape),
    )


def drop_strongest(hits: BeamHits) -> BeamHits:
    """Return what the rays met without the strongest group of every beam, the rays of which become misses."""
    ranges_m, photons = np.full_like(hits.ranges_m, np.inf), np.zeros_like(hits.photons)
    farthest_m = np.where(np.isinf(hits.ranges_m), np.float32(0.0), hits.ranges_m).max(axis=0)
    apart = np.flatnonzero(farthest_m - hits.ranges_m.min(axis=0) >= PULSE_M)
    if len(apart):
        own_m, own_light = hits.ranges_m[:, apart], hits.photons[:, apart]
        light, _, order = _strongest_group_light(own_m, own_light)
        is_rest = np.empty(order.shape, dtype=np.bool_)
        np.put_along_axis(is_rest, order, light == 0, axis=0)
        is_rest &= own_light > 0
        ranges_m[:, apart] = np.where(is_rest, own_m, np.float32(np.inf))
        photons[:, apart] = np.where(is_rest, own_light, np.float32(0.0))
    is_left = np.isfinite(ranges_m)
    geoms, cosines = (
        np.where(is_left, hits.geoms, np.int32(-1)),
        np.where(is_left, hits.cosines, np.float32(0.0)),
    )
    return BeamHits(ranges_m, photons, geoms, cosines)


def sub_ray_pattern(sub_rays: int) -> tuple[Float64Array, Float64Array]:
    """Return where a beam's rays lie and how much of its light each carries.

    A round Gaussian whose half-brightness circle has radius 1. Seven rays: the rule that integrates polynomials of
    degree 5 exactly, half the light in the middle, the rest in a hexagon two standard deviations out. Nineteen: a
    hexagonal lattice of spacing 1, two rings about the middle, each ray with the Gaussian's brightness there; cut
    off at radius 2, they are 4 % narrower than the Gaussian.

    Returns:
        (n, 2) places across the beam, (n,) shares that add up to 1; the middle first.
    """
    sixths = np.arange(6) * np.pi / 3
    hexagon = np.stack([np.cos(sixths), np.sin(sixths)], axis=1)
    middle = np.zeros((1, 2))
    if sub_rays == 7:
        two_sigma = 2.0 / np.sqrt(2.0 * np.log(2.0))
        return np.concatenate([middle, two_sigma * hexagon]), np.array([1 / 2] + [1 / 12] * 6)
    between = hexagon + np.roll(hexagon, -1, axis=0)
    places = np.concatenate([middle, hexagon, between, 2.0 * hexagon])
    weights = 0.5 ** (places**2).sum(axis=1)
    return places, weights / weights.sum()


def beam_bundle(places: Float64Array) -> Bundle:
    """Return the bundle of a beam's rays at places (n, 2) across it, as of `sub_ray_pattern`."""
    return Bundle(places, WAIST_M / 2, float(np.tan(DIVERGENCE_RAD / 2)))


def blend_echoes(ranges_m: Float32Array, photons: Float32Array) -> tuple[Float32Array, Float32Array, Int64Array]:
    """Blend the echoes of each pixel's rays.

    Args:
        ranges_m: (n, N) distance of each ray's echo, infinite for a miss.
        photons: (n, N) its photons, 0 for a miss.

    Returns:
        (N,) range of the strongest group, 0 where all rays miss; (N,) its photons; (N,) its strongest ray.
    """
    nearest, farthest = np.full_like(ranges_m[0], np.inf), np.zeros_like(ranges_m[0])
    strength, moment = np.zeros_like(farthest), np.zeros_like(farthest)
    best, strongest = np.full_like(farthest, -1.0), np.zeros(len(farthest), np.int64)
    for ray, (reach_m, light) in enumerate(zip(ranges_m, photons, strict=True)):
        finite_m = np.where(np.isinf(reach_m), np.float32(0.0), reach_m)
        np.minimum(nearest, reach_m, out=nearest)
        np.maximum(farthest, finite_m, out=farthest)
        strength += light
        moment += light * finite_m
        is_better = light > best
        best[is_better] = light[is_better]
        strongest[is_better] = ray
    range_m = moment / np.maximum(strength, np.float32(1e-30))
    apart = np.flatnonzero(farthest - nearest >= PULSE_M)
    if len(apart):
        range_m[apart], strength[apart], strongest[apart] = _strongest_group(ranges_m[:, apart], photons[:, apart])
    return range_m, strength, strongest


def divide_light(owners: Int32Array, ranges_m: Float32Array, photons: Float32Array) -> tuple[Int32Array, Float32Array]:
    """Find whose surfaces reflected most of the light that each pixel reports.

    Args:
        owners: (n, N) owner of the surface that each ray met; any owner for a miss.
        ranges_m: (n, N) distance of each ray's echo, infinite for a miss.
        photons: (n, N) its photons, 0 for a miss.

    Returns:
        (N,) owner of the largest part of the strongest group's light, (N,) that part as a share; 1 where all is dark.
    """
    owner, share = owners[0].copy(), np.ones(owners.shape[1], np.float32)
    shared = np.flatnonzero((owners != owner).any(axis=0))
    light, _, order = _strongest_group_light(ranges_m[:, shared], photons[:, shared])
    of_ray = np.take_along_axis(owners[:, shared], order, axis=0)
    totals = np.stack([np.where(of_ray == each, light, np.float32(0.0)).sum(axis=0) for each in of_ray])
    largest, pixels = totals.argmax(axis=0), np.arange(len(shared))
    owner[shared] = of_ray[largest, pixels]
    strength = light.sum(axis=0)
    share[shared] = np.where(strength > 0, totals[largest, pixels] / np.maximum(strength, np.float32(1e-30)), 1.0)
    return owner, share


def _strongest_group(
    ranges_m: Float32Array, photons: Float32Array
) -> tuple[Float32Array, Float32Array, npt.NDArray[np.int64]]:
    """Blend pixels (n, M) whose echoes may lie in several groups; misses, far away and dark, make up the last one."""
    light, reach_m, order = _strongest_group_light(ranges_m, photons)
    strength = light.sum(axis=0)
    range_m = (light * reach_m).sum(axis=0) / np.maximum(strength, np.float32(1e-30))
    return range_m, strength, order[light.argmax(axis=0), np.arange(order.shape[1])]


def _strongest_group_light(
    ranges_m: Float32Array, photons: Float32Array
) -> tuple[Float32Array, Float32Array, Int64Array]:
    """Return the (n, M) light and range of each ray, by rising range, and which ray that is; no light of weaker groups.

    Misses count as 1,000 km away.
    """
    order = np.argsort(ranges_m, axis=0, kind="stable")
    reach_m = np.take_along_axis(np.where(np.isinf(ranges_m), np.float32(1e6), ranges_m), order, axis=0)
    light = np.take_along_axis(photons, order, axis=0)
    group = np.zeros(order.shape, np.int64)
    np.cumsum(np.diff(reach_m, axis=0) >= PULSE_M, axis=0, out=group[1:])
    pixels = np.arange(order.shape[1])
    totals = np.zeros_like(light)
    for place, row in zip(group, light, strict=True):
        totals[place, pixels] += row
    return np.where(group == totals.argmax(axis=0), light, np.float32(0.0)), reach_m, order
