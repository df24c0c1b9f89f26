"""Kernels of package `warp-lang` that blend the echoes of a beam's rays, as `sim.sensor.footprint` does with numpy."""

# Warp reads the annotations of a kernel when it is decorated: they must be objects, not strings, and are no types.
# mypy: ignore-errors
import warp as wp

from sim.sensor.optics import NEAR_M, OVERLAP_M, OVERLAP_POWER, PHOTONS_AT_1_M

wp.set_module_options({"fuse_fp": False, "enable_backward": False})

_NEAR_M, _OVERLAP_M = wp.constant(wp.float64(NEAR_M)), wp.constant(wp.float64(OVERLAP_M))
_OVERLAP_POWER, _PHOTONS_AT_1_M = wp.constant(wp.float64(OVERLAP_POWER)), wp.constant(wp.float64(PHOTONS_AT_1_M))


@wp.kernel
def shine(
    reflectivity: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    beam_origin_m: wp.float32,
    ranges_m: wp.array2d(dtype=wp.float32),
    geoms: wp.array2d(dtype=wp.int32),
    cosines: wp.array2d(dtype=wp.float32),
    photons: wp.array2d(dtype=wp.float32),
) -> None:
    """Lengthen ranges (n, N) to those of the receiver, and compute the photons of each ray; no retroreflectors."""
    ray, beam = wp.tid()
    range_m = ranges_m[ray, beam] + beam_origin_m
    ranges_m[ray, beam] = range_m
    photons[ray, beam] = 0.0
    if geoms[ray, beam] >= 0:
        reach_m = wp.max(wp.float64(range_m), _NEAR_M)
        overlap = wp.float64(1.0) + wp.pow(_OVERLAP_M / reach_m, _OVERLAP_POWER)
        white = wp.float32(_PHOTONS_AT_1_M / (reach_m * reach_m * overlap))
        photons[ray, beam] = weights[ray] * (reflectivity[geoms[ray, beam]] * cosines[ray, beam] * white)


@wp.kernel
def drop_unheard(
    least_m: wp.float32,
    most_m: wp.float32,
    pulse_m: wp.float32,
    ranges_m: wp.array2d(dtype=wp.float32),
    geoms: wp.array2d(dtype=wp.int32),
    cosines: wp.array2d(dtype=wp.float32),
    photons: wp.array2d(dtype=wp.float32),
) -> None:
    """Let rays of beams (N,) miss what lies outside the limits, where `sim.sensor.footprint.cast_beams` says so."""
    beam = wp.tid()
    nearest_m, farthest_m = wp.float32(wp.inf), wp.float32(0.0)
    n_in = wp.int32(0)
    for ray in range(ranges_m.shape[0]):
        range_m = ranges_m[ray, beam]
        if geoms[ray, beam] >= 0:
            nearest_m = wp.min(nearest_m, range_m)
            farthest_m = wp.max(farthest_m, range_m)
            if range_m >= least_m and range_m <= most_m and photons[ray, beam] > 0.0:
                n_in += 1
    if n_in > 0 and farthest_m - nearest_m >= pulse_m:
        for ray in range(ranges_m.shape[0]):
            if ranges_m[ray, beam] < least_m or ranges_m[ray, beam] > most_m:
                ranges_m[ray, beam] = wp.inf
                geoms[ray, beam] = -1
                cosines[ray, beam] = 0.0
                photons[ray, beam] = 0.0


@wp.func
def find_strongest(
    beam: wp.int32, pulse_m: wp.float32, ranges_m: wp.array2d(dtype=wp.float32), photons: wp.array2d(dtype=wp.float32)
) -> wp.vec2:
    """Return the nearest and the farthest range of the group of a beam's echoes that has most photons."""
    window = wp.vec2(0.0, wp.inf)
    most = wp.float32(-1.0)
    for first in range(ranges_m.shape[0]):
        near_m = ranges_m[first, beam]
        is_start = near_m < wp.inf
        for ray in range(ranges_m.shape[0]):
            gap_m = near_m - ranges_m[ray, beam]
            is_start = is_start and not (gap_m > 0.0 and gap_m < pulse_m)
        if is_start:
            far_m = wp.float32(near_m)
            last_m = wp.float32(-1.0)
            while far_m > last_m:
                last_m = far_m
                for ray in range(ranges_m.shape[0]):
                    range_m = ranges_m[ray, beam]
                    if range_m > last_m and range_m - last_m < pulse_m:
                        far_m = wp.max(far_m, range_m)
            light = wp.float32(0.0)
            for ray in range(ranges_m.shape[0]):
                if ranges_m[ray, beam] >= near_m and ranges_m[ray, beam] <= far_m:
                    light += photons[ray, beam]
            if light > most or (light == most and near_m < window[0]):
                most = light
                window = wp.vec2(near_m, far_m)
    return window


@wp.kernel
def blend(
    owners: wp.array(dtype=wp.int32),
    pulse_m: wp.float32,
    ranges_m: wp.array2d(dtype=wp.float32),
    geoms: wp.array2d(dtype=wp.int32),
    cosines: wp.array2d(dtype=wp.float32),
    photons: wp.array2d(dtype=wp.float32),
    echo: wp.array2d(dtype=wp.float32),
    names: wp.array2d(dtype=wp.int32),
) -> None:
    """Blend the strongest group of every beam (N,): range, photons, cosine, true range, share; geom, owner."""
    beam = wp.tid()
    nearest_m, farthest_m = wp.float32(wp.inf), wp.float32(0.0)
    for ray in range(ranges_m.shape[0]):
        if geoms[ray, beam] >= 0:
            nearest_m = wp.min(nearest_m, ranges_m[ray, beam])
            farthest_m = wp.max(farthest_m, ranges_m[ray, beam])
    window = wp.vec2(nearest_m, farthest_m)
    if farthest_m - nearest_m >= pulse_m:
        window = find_strongest(beam, pulse_m, ranges_m, photons)
    strength, moment, best = wp.float32(0.0), wp.float32(0.0), wp.float32(-1.0)
    most, strongest, owner = wp.float32(-1.0), wp.int32(0), wp.int32(0)
    for ray in range(ranges_m.shape[0]):
        range_m = ranges_m[ray, beam]
        if geoms[ray, beam] >= 0 and range_m >= window[0] and range_m <= window[1]:
            light = photons[ray, beam]
            strength += light
            moment += light * range_m
            if light > best:
                best = light
                strongest = ray
            own, shared = owners[geoms[ray, beam]], wp.float32(0.0)
            for other in range(ranges_m.shape[0]):
                reach_m = ranges_m[other, beam]
                # In Warp `and` evaluates both sides.
                if geoms[other, beam] >= 0 and reach_m >= window[0] and reach_m <= window[1]:  # noqa: SIM102
                    if owners[geoms[other, beam]] == own:
                        shared += photons[other, beam]
            if shared > most:
                most = shared
                owner = own
    echo[0, beam] = moment / wp.max(strength, 1.0e-30)
    echo[1, beam] = strength
    echo[2, beam] = cosines[strongest, beam]
    echo[3, beam] = ranges_m[strongest, beam]
    echo[4, beam] = 1.0
    if strength > 0.0:
        echo[4, beam] = most / strength
    names[0, beam] = geoms[strongest, beam]
    names[1, beam] = owner
