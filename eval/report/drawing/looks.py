"""The look of every method: a colour, a dash and a marker that belong to its name, in every chart of every page.

No two known methods share colour and dash, and those of one dash can be told apart by the colour-blind (tested). The
oracles, which are told the truth, are grey. A name that is not known gets one of the looks that no known method has,
by a checksum of the name and never black: the same name has the same look everywhere, and two such names may share one.
"""

from __future__ import annotations

import itertools
import re
import zlib
from dataclasses import replace

from eval.core.charts import BLACK, BLUE, DASHES, GREEN, ORANGE, SYMBOLS, VERMILLION, Dash, Look
from eval.tables.rows import is_told_the_truth

_SKY, _PURPLE, _WINE, GREY = "#56B4E9", "#CC79A7", "#882255", "#8a8a8a"
COLOURS = (BLACK, BLUE, ORANGE, GREEN, VERMILLION, _SKY, _PURPLE, _WINE)
_SIZE_PT = 4.5
KNOWN = {
    "tunnelcd": Look(BLACK, 2.2, "solid", "circle", _SIZE_PT),
    "every-keyframe": Look(BLACK, 1.4, "dash", "hexagon", _SIZE_PT),
    "frame": Look(BLACK, 1.4, "dashdot", "x", _SIZE_PT),
    "kiss-matcher": Look(ORANGE, 1.4, "dashdot", "star", _SIZE_PT),
    "paper": Look(BLUE, 1.6, "solid", "square", _SIZE_PT),
    "paper-paired": Look(BLUE, 1.4, "dash", "diamond", _SIZE_PT),
    "paper-topn": Look(BLUE, 1.4, "dot", "triangle-up", _SIZE_PT),
    "voxel-diff": Look(ORANGE, 1.6, "solid", "triangle-down", _SIZE_PT),
    "c2c": Look(VERMILLION, 1.6, "longdash", "diamond", _SIZE_PT),
    "m3c2": Look(GREEN, 1.6, "solid", "pentagon", _SIZE_PT),
    "m3c2-ep": Look(GREEN, 1.4, "dot", "hexagon", _SIZE_PT),
    "sphere-difference": Look(_SKY, 1.6, "longdash", "circle", _SIZE_PT),
    "range-net": Look(_PURPLE, 1.6, "solid", "star", _SIZE_PT),
    "dufomap": Look(_WINE, 1.6, "longdash", "square", _SIZE_PT),
    "octomap": Look(_WINE, 1.4, "dashdot", "triangle-up", _SIZE_PT),
    "removert": Look(_WINE, 1.4, "dashdotdot", "triangle-down", _SIZE_PT),
    "erasor": Look(ORANGE, 1.4, "dashdotdot", "x", _SIZE_PT),
    "scan-context": Look(_PURPLE, 1.4, "dash", "pentagon", _SIZE_PT),
    "solid": Look(_SKY, 1.4, "dashdotdot", "hexagon", _SIZE_PT),
    "untrained": Look(_SKY, 1.2, "dashdot", "diamond", _SIZE_PT),
    "random-regions": Look(VERMILLION, 1.2, "dot", "x", _SIZE_PT),
}
# What measures the rock looks like the method of its name; ours like `tunnelcd`.
_OF_SURFACE = {
    "planes": KNOWN["tunnelcd"], "m3c2": KNOWN["m3c2"], "m3c2-ep": KNOWN["m3c2-ep"], "c2c": KNOWN["c2c"],
    "c2m": Look(BLUE, 1.4, "longdash", "hexagon", _SIZE_PT), "unrolled": Look(_SKY, 1.6, "solid", "star", _SIZE_PT),
}  # fmt: skip
_SURFACE_METHOD = re.compile(r"\[(?:.*,)?surface\.method=([\w-]+)")
_ORACLES: dict[str, tuple[Dash, str]] = {
    "oracle-merge": ("dash", "circle"), "oracle-regions": ("dot", "square"),
    "oracle-merge+oracle-regions": ("dashdot", "diamond"),
}  # fmt: skip
_TAKEN = {(look.colour, look.dash) for look in (*KNOWN.values(), *_OF_SURFACE.values())}
_MARKED = {(look.colour, look.marker) for look in (*KNOWN.values(), *_OF_SURFACE.values())}
# Black is ours alone: in a picture of points, without dashes, a stranger would pass for `tunnelcd`.
_FREE = [pair for pair in itertools.product(COLOURS[1:], DASHES) if pair not in _TAKEN]


def look_of(name: str) -> Look:
    """Return the look of a method with its marker, for charts with a few points on a line."""
    if is_told_the_truth(name):
        by_sum = list(DASHES)[_place(name, len(DASHES))], SYMBOLS[_place(name, len(SYMBOLS))]
        dash, marker = _ORACLES.get(name, by_sum)
        return Look(GREY, 1.2, dash, marker, _SIZE_PT)
    if name in KNOWN:
        return KNOWN[name]
    of_surface = _SURFACE_METHOD.search(name)
    if of_surface and of_surface[1] in _OF_SURFACE:
        return _OF_SURFACE[of_surface[1]]
    colour, free_dash = _FREE[_place(name, len(_FREE))]
    markers = [marker for marker in SYMBOLS if (colour, marker) not in _MARKED]
    return Look(colour, 1.2, free_dash, markers[_place(name[::-1], len(markers))], _SIZE_PT)


def line_of(name: str) -> Look:
    """Return the look of a method without its marker, for lines through many points."""
    return replace(look_of(name), marker="")


def _place(name: str, n: int) -> int:
    return zlib.crc32(name.encode("utf-8", "surrogatepass")) % n
