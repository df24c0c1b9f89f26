"""Blending of a beam's echoes on the device of Warp that cast its rays."""

from __future__ import annotations

import numpy as np
import warp as wp

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array
from sim.geometry.bundles import Bundle
from sim.geometry.warp_caster import WarpCaster, load_kernels
from sim.sensor import kernels
from sim.sensor.rays import Rays


def blend_on_device(
    caster: WarpCaster,
    reflectivity: Float32Array,
    rays: Rays,
    beam_origin_m: float,
    owners: Int32Array,
    bundle: Bundle,
    weights: Float64Array,
    pulse_m: float,
    limits_m: tuple[float, float],
) -> tuple[Float32Array, Int32Array]:
    """Cast several rays over the width of every beam and blend their echoes, all on the device.

    Args:
        caster: The scene.
        reflectivity: (G,) of its geoms, none a retroreflector's.
        rays: The middle of every beam (W, H).
        beam_origin_m: Distance of their origins from the spin axis.
        owners: (G,) owner of each geom.
        bundle: The n rays of a beam.
        weights: (n,) share of the light of each.
        pulse_m: Echoes that follow one another by less are one group.
        limits_m: Least and greatest range at which the receiver listens.

    Returns:
        (5, W, H) range, photons, cosine, true range and owner's share as in `Echo`; (2, W, H) geom and owner.
    """
    width, height, _ = rays.directions.shape
    n_rays, n_beams = len(weights), width * height
    load_kernels(kernels, caster.device)
    with caster.turn:
        hits = caster.keep_bundles(rays.origins, rays.directions, bundle)
        photons = wp.empty((n_rays, n_beams), dtype=wp.float32, device=caster.device)
        told = [caster.put(reflectivity, wp.float32), caster.put(weights.astype(np.float32), wp.float32), beam_origin_m]
        wp.launch(kernels.shine, (n_rays, n_beams), inputs=[*told, *hits, photons], device=caster.device)
        wp.launch(kernels.drop_unheard, n_beams, inputs=[*limits_m, pulse_m, *hits, photons], device=caster.device)
        echo = wp.empty((5, n_beams), dtype=wp.float32, device=caster.device)
        names = wp.empty((2, n_beams), dtype=wp.int32, device=caster.device)
        told = [caster.put(owners, wp.int32), pulse_m, *hits, photons]
        wp.launch(kernels.blend, n_beams, inputs=told, outputs=[echo, names], device=caster.device)
        return echo.numpy().reshape(5, width, height), names.numpy().reshape(2, width, height)
