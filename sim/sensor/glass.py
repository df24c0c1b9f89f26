"""Panes of glass: most of a beam goes through, some of it is mirrored, and little comes back from the pane itself.

The strongest of three echoes is reported: dust on the pane, what stands behind it, and what it mirrors, which seems to
stand behind it, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from sim.geometry.raycast import Caster
from sim.sensor.footprint import (
    EVERYWHERE,
    Echo,
    Limits,
    choose_echo,
    no_echo,
    outweighs,
    replace_pixels,
    stronger_echo,
)
from sim.sensor.optics import MIRRORED, mirrored_share, received_photons, reflected_share
from sim.sensor.rays import Rays

GLASS_INDEX = 1.52  # soda-lime glass, near infrared
# Share of light at 865 nm that 4 to 6 mm of clear soda-lime glass absorb, by the iron in it: typical, unverified.
ABSORBED = 0.1
_MOST_FACES = 8  # that a beam is followed through, two for each pane
_BEYOND_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Panes:
    """The panes of a session, and the fixed scene that is seen through and in them; movers are not seen so.

    Attributes:
        caster: Caster of the fixed scene.
        reflectivity: (G,) share of the light that each of its geoms reflects.
        owners: (G,) owner of each of its geoms.
        is_glass: (G,) which of them are panes.
    """

    caster: Caster
    reflectivity: Float32Array
    owners: Int32Array
    is_glass: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Beams:
    """The middles of the N beams that meet a pane first.

    Attributes:
        pixel: (N,) flat numbers of their pixels.
        start: (N, 3) float64 where they meet it, world frame.
        way: (N, 3) float64 unit direction.
        normal: (N, 3) float64 unit normal of the pane.
        reach_m: (N,) float64 distance to it in the receiver.
    """

    pixel: Int64Array
    start: Float64Array
    way: Float64Array
    normal: Float64Array
    reach_m: Float64Array

    @property
    def cosine(self) -> Float64Array:
        """(N,) of the incidence on the pane."""
        return np.asarray(np.minimum(np.abs((self.way * self.normal).sum(axis=1)), 1.0))


def cross_glass(
    echo: Echo, rays: Rays, beam_origin_m: float, panes: Panes, limits: Limits = EVERYWHERE
) -> tuple[Echo, Echo]:
    """Return the strongest and the second echo of a revolution where beams meet glass.

    Args:
        echo: The echo as if glass were a wall.
        rays: The revolution's rays; the middle of a beam decides for the whole beam.
        beam_origin_m: Distance of their origins from the spin axis.
        panes: The panes, and what is seen in them.
        limits: The ranges at which the receiver listens.

    Returns:
        The strongest echo; and the second one of the beams that meet glass, nothing for all other beams.
    """
    first, second = echo, no_echo(echo)
    beams = _find_beams(echo, rays, beam_origin_m, panes)
    if len(beams.pixel):
        for found in (_look_through(echo, beams, panes), _look_back(echo, beams, panes)):
            is_stronger = outweighs(found, first, limits)
            second = stronger_echo(second, choose_echo(is_stronger, first, found), limits)
            first = choose_echo(is_stronger, found, first)
    return first, second


def _find_beams(echo: Echo, rays: Rays, beam_origin_m: float, panes: Panes) -> _Beams:
    """Return the beams that report a pane and the middles of which meet one."""
    is_fixed = (echo.geom >= 0) & (echo.geom < len(panes.is_glass))
    pixel = np.flatnonzero(is_fixed & panes.is_glass[np.where(is_fixed, echo.geom, 0)])
    column = pixel // rays.directions.shape[1]
    way = rays.directions.reshape(-1, 3)[pixel]
    range_m, geom, normal = panes.caster.hits(rays.origins[column], way)
    is_met = (geom >= 0) & panes.is_glass[geom]
    pixel, towards = pixel[is_met], way[is_met].astype(np.float64)
    met_m = range_m[is_met].astype(np.float64)
    start = rays.origins[column[is_met]] + met_m[:, None] * towards
    return _Beams(pixel, start, towards, normal[is_met].astype(np.float64), met_m + beam_origin_m)


def _look_through(echo: Echo, beams: _Beams, panes: Panes) -> Echo:
    """Return the echo of what stands behind the panes, dimmed by every face of glass on the way there and back."""
    n_beams = len(beams.pixel)
    passed = _pass_face(beams.cosine)
    gone_m, geom, facing = np.zeros(n_beams), np.full(n_beams, -1, np.int32), np.zeros(n_beams, np.float32)
    on_way = np.arange(n_beams)
    for _ in range(_MOST_FACES):
        points = beams.start[on_way] + (gone_m[on_way, None] + _BEYOND_M) * beams.way[on_way]
        further_m, met, cosine = panes.caster.cast(points, beams.way[on_way])
        gone_m[on_way] += _BEYOND_M + further_m
        is_pane = (met >= 0) & panes.is_glass[met]
        geom[on_way], facing[on_way] = np.where(is_pane, -1, met), np.where(is_pane, np.float32(0.0), cosine)
        on_way = on_way[is_pane]
        passed[on_way] *= _pass_face(cosine[is_pane].astype(np.float64))
    seen = _make_echo(echo, beams, panes, gone_m, geom, facing, passed)
    reach_m = seen.range_m.ravel()[beams.pixel]
    true_m = np.where(geom >= 0, reach_m, np.float32(np.inf))
    return replace_pixels(seen, beams.pixel, true_range_m=true_m, geom=geom, owner=panes.owners[geom])


def _look_back(echo: Echo, beams: _Beams, panes: Panes) -> Echo:
    """Return the echo of what the panes mirror."""
    turned = beams.way - 2.0 * (beams.way * beams.normal).sum(axis=1)[:, None] * beams.normal
    further_m, geom, facing = panes.caster.cast(beams.start + _BEYOND_M * turned, turned)
    mirrored = np.asarray(mirrored_share(beams.cosine, GLASS_INDEX))
    seen = _make_echo(echo, beams, panes, further_m, geom, facing, mirrored)
    return replace_pixels(seen, beams.pixel, geom=np.where(geom >= 0, np.int32(MIRRORED), np.int32(-1)))


def _make_echo(
    echo: Echo,
    beams: _Beams,
    panes: Panes,
    further_m: npt.NDArray[np.floating],
    geom: Int32Array,
    facing: Float32Array,
    share: Float64Array,
) -> Echo:
    """Return the echo of what the beams meet beyond the panes, its geoms still to be named.

    Args:
        echo: Gives the shape.
        beams: The N beams.
        panes: The scene.
        further_m: (N,) distance from the pane to what is met.
        geom: (N,) what is met, -1 for nothing.
        facing: (N,) cosine of the incidence on it.
        share: (N,) share of the light that passes, or is mirrored, each way.
    """
    is_met = geom >= 0
    range_m = np.where(is_met, beams.reach_m + np.where(is_met, further_m, 0.0), 0.0).astype(np.float32)
    power = reflected_share(panes.reflectivity, geom, facing) * np.square(share).astype(np.float32)
    light = received_photons(power, np.maximum(range_m, np.float32(1e-3)))
    photons = np.where(power > 0, light, np.float32(0.0))
    return replace_pixels(no_echo(echo), beams.pixel, range_m=range_m, photons=photons, cosine=facing)


def _pass_face(cosine: Float64Array) -> Float64Array:
    """Return the share of light that passes one face of a pane, and half its glass."""
    return np.asarray((1.0 - mirrored_share(cosine, GLASS_INDEX)) * np.sqrt(1.0 - ABSORBED))
