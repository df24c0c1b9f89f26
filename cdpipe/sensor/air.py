"""Returns of mist and dust: told by their weakness, and by neighbours that do not lie on one surface with them.

A surface within a few metres sends back tens of photons, the air in front of it a handful; and the places from which
air returns are scattered along the beams, while neighbouring beams meet a surface at ranges that agree or follow a
line. Published filters for snow use either: intensity (LIOR, Park and others 2020) and local density (DROR, Charron and
others 2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array

# Simulated validation worlds (10001 of six families). A scan is dusty by the first rule: it holds for 0.4 % of a clear
# scan at most, for 94 % and more of the returns of mist and dust. In a dusty scan the second rule drops what it can: in
# mist with 12, 20 and 40 m of visibility 0.8, 0.01 and 0.00 % of what is left are returns of the mist, and 9, 6 and 4 %
# of the surfaces are lost.
_FARTHEST_M = 20.0
# Too dark for a surface: fewer photons than this within such a range. Mist of 12 m of visibility lies so near to the
# sensor that neighbours agree (`dust/mist` 10013): 99 % of its returns within 1 m have 17 photons at most, rock behind
# as much of it 14 and more.
_DARK = ((1.0, 16), (3.0, 10))
_DUSTY_SHARE = 0.01


@dataclass(frozen=True, slots=True)
class _Rule:
    """A return is airborne if it is weak and fewer than two of its four neighbours agree with its range."""

    weak_photons: int
    agree_m: float
    agree_share: float
    may_lie_between: bool  # whether it may instead lie on the line between the next two


_IN_ANY_AIR = _Rule(16, 0.1, 0.02, may_lie_between=True)
_IN_DUST = _Rule(24, 0.05, 0.01, may_lie_between=False)


def find_clear_pixels(
    range_mm: npt.NDArray[np.uint32], signal: npt.NDArray[np.uint16], second_from: int | None = None
) -> BoolArray:
    """Return which pixels (R, W) of a revolution hold a return that does not look like one of mist or dust.

    Args:
        range_mm: (R, W) staggered ranges, millimetres, 0 for a miss.
        signal: (R, W) photons; all 0 if the recording has no such channel.
        second_from: As in `find_airborne`.
    """
    is_clear = range_mm > 0
    pixels = np.flatnonzero(is_clear)
    if len(pixels) and signal.any():
        found = find_airborne(range_mm.ravel()[pixels] / 1000.0, signal.ravel()[pixels], pixels, second_from)
        if found is not None:
            is_clear.ravel()[pixels[found]] = False
    return is_clear


def find_airborne(
    ranges_m: Float64Array, signal: npt.NDArray[np.uint16], pixels: npt.NDArray[np.integer], second_from: int | None
) -> BoolArray | None:
    """Mark the (N,) returns of mist and dust of a scan; None of clear air, and of a scan that would keep nothing.

    Args:
        ranges_m: (N,) distances from the sensor, metres.
        signal: (N,) photons.
        pixels: (N,) rising numbers of the beams, row by row.
        second_from: Pixels from this one on are second returns of the beams from pixel 0 on; None: one return a beam.
    """
    scan = _Returns(ranges_m, signal, pixels, second_from)
    if np.count_nonzero(_mark(scan, _IN_ANY_AIR)) <= _DUSTY_SHARE * len(pixels):
        return None
    is_airborne = _mark(scan, _IN_DUST)
    return None if is_airborne.all() else is_airborne


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """The returns (N,) of a scan, as in `find_airborne`."""

    ranges_m: Float64Array
    signal: npt.NDArray[np.uint16]
    pixels: npt.NDArray[np.integer]
    second_from: int | None


def _mark(scan: _Returns, rule: _Rule) -> BoolArray:
    """Mark the (N,) returns within 20 m that look airborne by a rule, and those too dark for a surface."""
    is_marked: BoolArray = (scan.signal < rule.weak_photons) & (scan.ranges_m < _FARTHEST_M)
    weak = np.flatnonzero(is_marked)
    is_dark = [(scan.ranges_m[weak] < near_m) & (scan.signal[weak] < photons) for near_m, photons in _DARK]
    is_marked[weak] = np.logical_or(*is_dark) | ~_is_on_surface(scan, weak, rule)
    return is_marked


def _is_on_surface(scan: _Returns, chosen: Int64Array, rule: _Rule) -> BoolArray:
    """Tell which (C,) chosen returns lie on one surface with the two beams on either side in their row.

    Of a beam with two returns either one may agree.
    """
    n_beams = scan.second_from or int(scan.pixels.max(initial=0)) + 1
    images = np.full((1 if scan.second_from is None else 2, n_beams + 4), np.nan)
    number, beam = np.divmod(scan.pixels, n_beams)
    images[number, beam + 2] = scan.ranges_m
    own, at = scan.ranges_m[chosen], beam[chosen] + 2
    tolerance_m = rule.agree_m + rule.agree_share * own
    around = {step: images[:, at + step] for step in (-2, -1, 1, 2)}
    agreeing = np.stack([(np.abs(other - own) < tolerance_m).any(axis=0) for other in around.values()])
    is_on: BoolArray = agreeing.sum(axis=0) >= 2
    if rule.may_lie_between:
        is_on |= (np.abs(around[-1][:, None] + around[1][None] - 2 * own) < tolerance_m).any(axis=(0, 1))
    return is_on
