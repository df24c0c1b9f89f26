"""The measures of some revolutions as rows of a table, one set of bins for recordings and simulations alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array
from eval.core.statistics import mean
from eval.studies.reality.sensor_measures import (
    Revolutions,
    estimate_photons,
    find_edges,
    find_isolated,
    measure_noise_sigma_m,
    measure_photons_per_percent,
    measure_return_share,
)
from eval.studies.reality.static_novelty import CELLS_M, REAL_SHARES, Case, Shares

COLUMNS = ("measure", "where", "unit", "source", "value", "n")
RANGE_BINS_M = (2.4, 4.0, 6.0, 9.0, 13.0, 20.0, 40.0)
PHOTON_BINS = (3.0, 6.0, 9.0, 12.0, 18.0, 25.0, 35.0, 50.0, 70.0, 100.0, 200.0, 400.0)
DETECTION_BINS = (4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 48.0, 100.0, 1e4)
JUMP_BINS_M = (1.0, 2.0, 4.0, 8.0)
FACING_BINS_M = (4.0, 13.0)  # ranges at which noise is listed by photons
_LEAST = 20  # fewest pixels of a figure
Row = tuple[str, str, str, float, int]  # COLUMNS without the source


def tabulate_measures(revolutions: Revolutions, source: str) -> pd.DataFrame:
    """Return every measure of some revolutions as rows of `COLUMNS`; bins with fewer than 20 pixels are left out."""
    parts = (_measure_returns, _measure_noise, _measure_signal, _measure_detection, _measure_outliers)
    rows = [row for part in parts for row in part(revolutions)]
    table = pd.DataFrame(rows, columns=[name for name in COLUMNS if name != "source"]).assign(source=source)
    return table[list(COLUMNS)]


def tabulate_surface(revolutions: Revolutions, is_surface: BoolArray, source: str) -> pd.DataFrame:
    """Return the share of returns among the (H, W) pixels with a surface in the rebuilt scene."""
    share = float(revolutions.is_return[:, is_surface].mean())
    row = ("returns where a surface is", "all", "share", source, share, int(is_surface.sum()))
    return pd.DataFrame([row], columns=list(COLUMNS))


def tabulate_novelty(results: Sequence[tuple[Case, Shares]]) -> pd.DataFrame:
    """Return one row per simulated session and the real one: way, variant, revolutions, percent new at each cell."""
    real = ("real recording of a static scene (stated)", "", np.nan, REAL_SHARES)
    sources = [real, *((case.way, case.variant, case.n_revolutions, shares) for case, shares in results)]
    rows = [(*source, *(100.0 * share for share in shares)) for *source, shares in sources]
    columns = ["way", "variant", "n_revolutions", *(f"new_percent_{cell:g}m" for cell in CELLS_M)]
    return pd.DataFrame(rows, columns=columns)


def arrange_by_source(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table of `COLUMNS` with a column for each source, beams summed up as lowest, highest and all."""
    beams = table["measure"] == "returns by beam"
    grouped = table[beams].groupby("source", sort=False)["value"]
    extremes = [
        ("returns by beam", name, "share", source, float(value), 0)
        for name, values in (("lowest", grouped.min()), ("highest", grouped.max()))
        for source, value in values.items()
    ]
    whole = pd.concat([table[~beams], pd.DataFrame(extremes, columns=list(COLUMNS))])
    measures = list(dict.fromkeys(table["measure"]))
    wide = whole.pivot_table(index=["measure", "where", "unit"], columns="source", values="value", sort=False)
    order = sorted(wide.index, key=lambda row: (measures.index(row[0]), find_first_number(row[1])))
    return wide.reindex(order)[list(dict.fromkeys(table["source"]))].reset_index()


def find_first_number(where: str) -> float:
    """Return the lower limit of a bin from its name; -1 for a name without limits."""
    numbers = [float(word) for word in where.split() if word[0].isdigit()]
    return numbers[0] if numbers else -1.0


def format_markdown(table: pd.DataFrame) -> str:
    """Return a table in Markdown: numbers with three significant digits, a dash for NaN."""
    lines = ["| " + " | ".join(str(name) for name in table.columns) + " |", "|---" * len(table.columns) + "|"]
    lines += ["| " + " | ".join(_format_cell(value) for value in row) + " |" for row in table.itertuples(index=False)]
    return "\n".join(lines) + "\n"


def _measure_returns(revolutions: Revolutions) -> Iterator[Row]:
    n_pixels = revolutions.range_m[:, 0].size
    yield "returns", "all", "share", float(revolutions.is_return.mean()), revolutions.range_m.size
    for beam, share in enumerate(measure_return_share(revolutions)):
        yield "returns by beam", str(beam), "share", float(share), n_pixels


def _measure_noise(revolutions: Revolutions) -> Iterator[Row]:
    def rows(name: str, values: Float64Array, limits: Sequence[float], unit: str, among: BoolArray) -> Iterator[Row]:
        for label, inside in _split_into_bins(values, limits, unit):
            where = among & inside
            yield from _make_row(name, label, "mm", 1e3 * measure_noise_sigma_m(revolutions, where), where)

    range_m, facing = revolutions.range_m, revolutions.is_smooth & revolutions.is_facing
    yield from rows("range noise, smooth", range_m, RANGE_BINS_M, "m", revolutions.is_smooth)
    yield from rows("range noise, facing", range_m, RANGE_BINS_M, "m", facing)
    near = facing & (range_m >= FACING_BINS_M[0]) & (range_m < FACING_BINS_M[1])
    yield from rows("range noise, facing, 4 to 13 m", revolutions.signal, PHOTON_BINS, "photons", near)


def _measure_signal(revolutions: Revolutions) -> Iterator[Row]:
    for label, inside in _split_into_bins(revolutions.range_m, (*RANGE_BINS_M, 70.0), "m"):
        values = measure_photons_per_percent(revolutions, inside)
        if len(values) >= _LEAST:
            yield "photons x range^2 per percent", label, "m^2", float(np.median(values)), len(values)


def _measure_detection(revolutions: Revolutions) -> Iterator[Row]:
    for label, inside in _split_into_bins(np.nan_to_num(estimate_photons(revolutions)), DETECTION_BINS, "photons"):
        share = mean(revolutions.is_return[inside])
        yield from _make_row("returns by photons of the neighbours", label, "share", share, inside)


def _measure_outliers(revolutions: Revolutions) -> Iterator[Row]:
    is_return, alone = revolutions.is_return, find_isolated(revolutions)
    yield from _make_row("isolated returns", "all", "share", mean(alone[is_return]), is_return)
    for label, inside in _split_into_bins(revolutions.range_m, RANGE_BINS_M, "m"):
        yield from _make_row("isolated returns", label, "share", mean(alone[inside]), inside)
    jump_m, is_mixed, is_missing = find_edges(revolutions)
    is_edge = np.isfinite(jump_m)
    yield from _make_row("missing at edges", "all", "share", mean(is_missing[is_edge]), is_edge)
    for label, inside in _split_into_bins(np.nan_to_num(jump_m), JUMP_BINS_M, "m"):
        where = inside & is_return
        yield from _make_row("mixed at edges", f"jump {label}", "share", mean(is_mixed[where]), where)


def _split_into_bins(values: Float64Array, limits: Sequence[float], unit: str) -> Iterator[tuple[str, BoolArray]]:
    for low, high in pairwise(limits):
        name = f"{low:g} to {high:g} {unit}" if high < 1e4 else f"{low:g} {unit} or more"
        yield name, (values >= low) & (values < high)


def _make_row(measure: str, where: str, unit: str, value: float, counted: BoolArray) -> Iterator[Row]:
    n = int(np.count_nonzero(counted))
    if n >= _LEAST:
        yield measure, where, unit, value, n


def _format_cell(value: object) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.3g}"
    return str(value)
