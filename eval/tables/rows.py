"""Rows of results.csv and of the item tables: their columns as arrays, the pairs and domains they belong to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from eval.core.domains import domain_of
from eval.core.statistics import interval_over_tunnels, mean, wilson_interval
from scenarios.catalogue import tunnel_family

PAIR = ["scenario", "seed"]
ALL_DOMAINS = "all"
DOMAINS = ("in", "out", ALL_DOMAINS)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as dictionaries."""
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


def texts(table: pd.DataFrame, column: str) -> np.ndarray[Any, np.dtype[np.object_]]:
    """Return an (N,) column as texts, "" where it is empty or absent."""
    if column not in table:
        return np.full(len(table), "", dtype=object)
    return np.array(["" if pd.isna(value) else str(value) for value in table[column]], dtype=object)


def numbers(table: pd.DataFrame, column: str) -> Float64Array:
    """Return an (N,) column as numbers, NaN where it is empty or absent."""
    if column not in table:
        return np.full(len(table), np.nan)
    return pd.to_numeric(table[column], errors="coerce").to_numpy(dtype=np.float64)


def forced(regions: pd.DataFrame) -> BoolArray:
    """Return (N,) which rows of regions.csv no threshold silences; none in tables of older runs, without the column."""
    return np.asarray(regions["is_forced"].eq(True) if "is_forced" in regions else np.zeros(len(regions)), np.bool_)


def tunnel_numbers(worlds: Iterable[str], seeds: Iterable[int]) -> Int64Array:
    """Return (N,) a number for the tunnel of each pair, in the order of their first pairs.

    Pairs of one seed share it where their worlds differ by settings, or their families by anything but the tunnel
    (`scenarios.catalogue.tunnel_family`). They are no independent samples: intervals draw them together.
    """
    keys = [(tunnel_family(str(world).partition("[")[0]), int(seed)) for world, seed in zip(worlds, seeds, strict=True)]
    place: dict[tuple[str, int], int] = {}
    return np.array([place.setdefault(key, len(place)) for key in keys], dtype=np.int64)


def tunnels_of(table: pd.DataFrame) -> Int64Array:
    """Return (N,) the number of the tunnel of each row of a table with scenario and seed, as `tunnel_numbers` does."""
    return tunnel_numbers(table["scenario"], table["seed"])


def means_with_intervals(table: pd.DataFrame, columns: Iterable[str]) -> dict[str, float]:
    """Return the mean of each column over session pairs, and its 95 % interval under `..._low` and `..._high`.

    The interval draws tunnels with all of their pairs.
    """
    found: dict[str, float] = {}
    tunnels = tunnels_of(table)
    for name in columns:
        values = numbers(table, name)
        found[name] = mean(values)
        found[f"{name}_low"], found[f"{name}_high"] = interval_over_tunnels(values, tunnels)
    return found


def is_told_the_truth(variant: str) -> bool:
    """Tell whether a variant takes its merge or its regions from the truth."""
    return variant.startswith("oracle-")


def with_domain(rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of results.csv as a table, with their `domain`.

    It is that with which they were scored: what networks had seen then.
    """
    table = (rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))).copy()  # in one block
    family, stored = texts(table, "family" if "family" in table else "scenario"), texts(table, "domain")
    named = zip(family, stored, strict=True)
    return table.assign(domain=[told if told in DOMAINS[:2] else domain_of(name) for name, told in named])


def is_answered(cases: pd.DataFrame) -> BoolArray:
    """Mark the rows of results.csv, or of their figures, that are of an answer."""
    told = cases["status"] == "ok" if "status" in cases else cases["is_answered"] == 1
    return told.to_numpy(dtype=np.bool_)


def with_pair(results: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of results.csv that have a pair: a world that was not made asks nothing."""
    if "n_observable" not in results:
        return results
    return results[results["n_observable"].notna() | (results["status"] == "ok")]


def without_costs_of_failures(results: pd.DataFrame) -> pd.DataFrame:
    """Return rows of results.csv in which rows without an answer state neither times nor bytes.

    A refused merge has its own time, and a failed answer may state any: none is what an answer costs.
    """
    costs = [name for name in results.columns if str(name).startswith(("t_", "bytes_"))]
    is_of_answer = is_answered(results)
    return results.assign(**{name: results[name].where(is_of_answer) for name in costs})


def wilson_over_tunnels(is_hit: BoolArray, results: pd.DataFrame) -> tuple[float, float]:
    """Return the 95 % Wilson interval of the share of (N,) pairs that are hits, as of so many as there are tunnels."""
    share = len(np.unique(tunnels_of(results))) / max(len(results), 1)
    return wilson_interval(int(np.count_nonzero(is_hit)) * share, len(results) * share)


def count_failed(results: pd.DataFrame) -> int:
    """Return how many rows of results.csv have a pair, but no answer."""
    return int((with_pair(results)["status"] != "ok").sum())


def stated(cases: pd.DataFrame, column: str) -> Float64Array:
    """Return an (N,) column of the rows of one method as numbers; of a cost that some answer leaves out, NaN for all.

    Else a method could state it where it is small.
    """
    values = numbers(cases, column)
    is_cost = column.startswith(("t_total", "bytes_"))  # seconds per region are undefined where no region is proposed
    is_left_out = np.isnan(values) & is_answered(cases)
    return np.full(len(values), np.nan) if is_cost and is_left_out.any() else values


def stated_columns(cases: pd.DataFrame, columns: Iterable[str]) -> pd.DataFrame:
    """Return columns of the rows of one method as `stated` does, with the index of the rows."""
    return pd.DataFrame({column: stated(cases, column) for column in columns}, index=cases.index)


def by_domain(results: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the rows of each domain that is present, and all rows where both are.

    Args:
        results: Rows of results.csv with their `domain`.
    """
    present = [name for name in DOMAINS if (results["domain"] == name).any()]
    yield from ((name, results[results["domain"] == name]) for name in present)
    if len(present) > 1:
        yield ALL_DOMAINS, results


def by_variant(items: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the rows of an item table by variant; `of_cases` is slow on a whole table."""
    return {str(variant): own for variant, own in items.groupby("variant", sort=False)} if len(items) else {}


def of_cases(items: pd.DataFrame, cases: pd.DataFrame, needed: Sequence[str] = ()) -> pd.DataFrame:
    """Return the items (changes, regions, keyframes) of some rows of results.csv, in their order.

    Args:
        items: Rows of an item table.
        cases: Rows of results.csv.
        needed: Columns that an empty answer must have.
    """
    wanted = [*PAIR, "variant"]
    own = items.merge(cases[wanted].drop_duplicates(), on=wanted, how="inner") if len(items) else items
    return own.assign(**{name: [] for name in (*wanted, *needed) if name not in own}) if len(own) == 0 else own
