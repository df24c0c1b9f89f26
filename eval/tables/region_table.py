"""What a run says about regions: every method in and out of the training distribution, and the targets of `tunnelcd`.

The unit is the session pair. A pair without an answer counts as missing all its changes and is never silent; what it
would have said about its keyframes is unknown, so AUROC is over the answered pairs, and `n_auroc` says how many.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from eval.core.domains import domain_of
from eval.core.ranking import auroc
from eval.core.statistics import mean_with_interval, wilson_interval
from eval.tables.merge_table import numbers, texts
from eval.tables.region_curves import (
    PAIR,
    RATES_PER_100M,
    RankedPairs,
    free_response,
    interval_of,
    ranked_pairs,
    recall_at,
    resampled_recalls,
    roc_curve,
)
from eval.tables.region_sizes import recall_by_size

ALL_DOMAINS = "all"
DOMAINS = ("in", "out", ALL_DOMAINS)
MAIN_VARIANT, PAPER_VARIANT = "tunnelcd", "paper"
RIVALS = ("voxel-diff", "c2c")
FILES = ("regions_table", "regions_targets", "regions_by_size", "roc", "froc")
LEAST_KM = 5.0
_MEANS = (
    "region_auroc", "region_recall_at_k", "region_recall_at_k_proposed", "region_recall", "region_recall_proposed",
    "region_precision",
)  # fmt: skip
_MEDIANS = ("t_descriptor_per_keyframe_s", "t_cd_per_region_s")
_AUROC, _RECALL_AT_K = {"in": 0.97, "out": 0.93}, {"in": 0.95, "out": 0.90}
_WORDS = {"region_auroc": "AUROC", "region_recall_at_k": "recall at K"}
_BYTES, _T_CD_S = {"site1": 10.0, "site2": 35.0}, {"site1": 0.016, "site2": 0.109}
_SILENT, _FALSE_PER_100M = 0.95, 0.1
_ROUNDING = 1e-9


def region_tables(
    results: pd.DataFrame, items: Mapping[str, pd.DataFrame], *, is_whole: bool = True
) -> dict[str, pd.DataFrame]:
    """Return the tables of a run about regions, by file name.

    Args:
        results: Rows as in results.csv.
        items: `changes`, `regions` and `keyframes`, as in the files of those names.
        is_whole: Whether all that was planned is in them; otherwise nothing is said to be met or not.

    Returns:
        regions_table: a row for every domain and variant; regions_targets: what is asked of `tunnelcd`, and what it
        does; regions_by_size: recall by size, returns and range of the change; roc, froc: the curves.
    """
    results = results.assign(domain=[domain_of(family) for family in texts(results, "family")])
    rows: list[dict[str, Any]] = []
    sizes: list[dict[str, Any]] = []
    curves: dict[str, list[pd.DataFrame]] = {"roc": [], "froc": []}
    ranked: dict[tuple[str, str], RankedPairs] = {}
    present = [name for name in DOMAINS[:2] if (results["domain"] == name).any()]
    for domain in [*present, *([ALL_DOMAINS] if len(present) > 1 else [])]:
        cases = results if domain == ALL_DOMAINS else results[results["domain"] == domain]
        for variant, own in cases.groupby("variant", sort=False):
            names = {"domain": domain, "variant": str(variant)}
            regions, changes, keyframes = (_of_cases(items[name], own) for name in ("regions", "changes", "keyframes"))
            each = ranked[domain, str(variant)] = ranked_pairs(own, regions, changes)
            labelled = keyframes[keyframes["label"] >= 0]
            scores, positive = labelled["score"].to_numpy(dtype=np.float64), labelled["label"].to_numpy() == 1
            rows.append({**names, **_counts(own), "region_auroc_pooled": auroc(scores, positive), **_operating(each)})
            rows[-1] |= _proposed(ranked_pairs(own, regions, changes, is_proposal=True))
            sizes += [{**names, **row} for row in recall_by_size(each, changes)]
            roc, froc = roc_curve(scores, positive), free_response(each)
            curves["roc"].append(_curve(names, roc, ("false_positive_rate", "true_positive_rate")))
            curves["froc"].append(_curve(names, froc, ("false_regions_per_100m", "recall")))
    table = pd.DataFrame(rows)
    return {
        "regions_table": table,
        "regions_targets": region_targets(table, results, ranked, is_whole=is_whole),
        "regions_by_size": pd.DataFrame(sizes),
        **{name: pd.concat(parts, ignore_index=True) for name, parts in curves.items()},
    }


def region_overview(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of regions_table.csv that a terminal has room for."""
    names = {
        "domain": "domain", "variant": "variant", "n_pairs": "n", "n_failed": "failed", "region_auroc": "auroc",
        "region_auroc_low": "low", "region_auroc_high": "high", "region_auroc_pooled": "pooled",
        "region_recall_at_k": "recall_at_k", "region_recall": "recall", "region_precision": "precision",
        "false_regions_per_100m": "false/100m", "recall_at_0.1": "recall@0.1", "recall_at_0.1_low": "low ",
        "recall_at_0.1_high": "high ", "silent_share": "silent", "n_unchanged": "of", "km_unchanged": "km",
        "bytes_ratio": "bytes 1/", "t_descriptor_per_keyframe_s": "t_desc/kf", "t_cd_per_region_s": "t_cd/region",
    }  # fmt: skip
    return table[list(names)].rename(columns=names)


def region_targets(
    table: pd.DataFrame,
    results: pd.DataFrame,
    ranked: Mapping[tuple[str, str], RankedPairs],
    *,
    is_whole: bool,
) -> pd.DataFrame:
    """Return what is asked of `tunnelcd` (and, of its time, of `paper`) and whether it is met; no row without data.

    Returns:
        `target`, `domain`, `variant`, `value` with `low` and `high` where there is an interval, `asked` ("at least
        0.97"), `n` pairs, and `is_met`: None where no verdict is passed.
    """
    found: list[dict[str, Any]] = []
    for row in (_named(row) for row in table[table["variant"] == MAIN_VARIANT].to_dict("records")):
        domain = str(row["domain"])
        for column, asked in (("region_auroc", _AUROC), ("region_recall_at_k", _RECALL_AT_K)):
            if domain in asked:
                interval = (row[f"{column}_low"], row[f"{column}_high"])
                n = row["n_auroc"] if column == "region_auroc" else row["n_changed"]
                found.append(_target(_WORDS[column], domain, (row[column], *interval), "at least", asked[domain], n))
    judged = [(domain, rival) for domain, rival in ranked if rival in RIVALS and domain != ALL_DOMAINS]
    found += [_against(domain, rival, ranked) for domain, rival in judged if (domain, MAIN_VARIANT) in ranked]
    found += [*_unchanged_targets(table), *_site_targets(results)]
    kept = [row for row in found if not math.isnan(row["value"])]
    if not is_whole:
        kept = [{**row, "is_met": None} for row in kept]
    columns = ["target", "domain", "variant", "value", "low", "high", "asked", "n", "is_met"]
    return pd.DataFrame(kept, columns=columns).astype({"is_met": object})


def _of_cases(items: pd.DataFrame, cases: pd.DataFrame) -> pd.DataFrame:
    """Return the items of some rows of results.csv, in their order, with the columns that readers ask for."""
    wanted = [*PAIR, "variant"]
    own = items.merge(cases[wanted].drop_duplicates(), on=wanted, how="inner") if len(items) else items
    needed = (
        *wanted,
        "id",
        "is_observable",
        "is_found",
        "n_truth_cells",
        "score",
        "found_changes",
        "is_withdrawn",
        "label",
    )
    return own.assign(**{name: [] for name in needed if name not in own}) if len(own) == 0 else own


def _curve(names: Mapping[str, str], points: tuple[Any, Any], columns: tuple[str, str]) -> pd.DataFrame:
    return pd.DataFrame(
        {**{key: [value] * len(points[0]) for key, value in names.items()}, **dict(zip(columns, points, strict=True))}
    )


def _counts(own: pd.DataFrame) -> dict[str, Any]:
    answered = own[own["status"] == "ok"]
    path_m, n_false = numbers(answered, "after_path_m").sum(), numbers(answered, "n_false_regions").sum()
    is_unchanged = own["is_unchanged_pair"].astype("boolean").fillna(value=False).to_numpy(dtype=bool)
    unchanged = own[is_unchanged]
    alarms = numbers(unchanged, "is_alarm")
    n_silent, n_unchanged = int((alarms == 0).sum()), len(unchanged)
    unchanged_m = numbers(unchanged, "after_path_m")[~np.isnan(alarms)].sum()
    n_false_unchanged = np.nansum(numbers(unchanged, "n_false_regions")[~np.isnan(alarms)])
    map_bytes, kept_bytes = numbers(answered, "bytes_map_before"), numbers(answered, "bytes_regions_before")
    means: dict[str, Any] = {}
    for name in _MEANS:
        value, low, high, _ = mean_with_interval(numbers(own, name))
        means |= {name: value, f"{name}_low": low, f"{name}_high": high}
    return {
        "n_pairs": len(own),
        "n_refused": int((own["status"] == "merge_refused").sum()),
        "n_failed": int((own["status"] != "ok").sum()),
        "n_auroc": int(np.count_nonzero(~np.isnan(numbers(own, "region_auroc")))),
        "n_changed": int(np.count_nonzero(numbers(own, "n_observable") > 0)),
        "n_observable": int(np.nansum(numbers(own, "n_observable"))),
        "n_found": int(np.nansum(numbers(own, "n_found_changes"))),
        **means,
        "km": path_m / 1000.0,
        "false_regions_per_100m": 100.0 * n_false / path_m if path_m > 0 else math.nan,
        "n_unchanged": n_unchanged,
        "n_silent": n_silent,
        "silent_share": n_silent / n_unchanged if n_unchanged else math.nan,
        **dict(zip(("silent_low", "silent_high"), wilson_interval(n_silent, n_unchanged), strict=True)),
        "km_unchanged": unchanged_m / 1000.0,
        "false_regions_per_100m_unchanged": 100.0 * n_false_unchanged / unchanged_m if unchanged_m > 0 else math.nan,
        "bytes_map_before": _mean(map_bytes),
        "bytes_regions_before": _mean(kept_bytes),
        "bytes_ratio": _mean(map_bytes / kept_bytes),
        **{name: _median(numbers(answered, name)) for name in _MEDIANS},
    }


def _operating(ranked: RankedPairs) -> dict[str, float]:
    """Return recall at each false-alarm rate with its interval."""
    found: dict[str, float] = {}
    is_enough = np.count_nonzero(ranked.n_observable) > 1
    for rate in RATES_PER_100M:
        low, high = interval_of(resampled_recalls(ranked, rate)) if is_enough else (math.nan, math.nan)
        name = f"recall_at_{rate:g}"
        found |= {name: recall_at(ranked, rate), f"{name}_low": low, f"{name}_high": high}
    return found


def _proposed(ranked: RankedPairs) -> dict[str, float]:
    """Return recall at each false-alarm rate as if no candidate had been withdrawn."""
    return {f"recall_at_{rate:g}_proposed": recall_at(ranked, rate) for rate in RATES_PER_100M}


def _against(domain: str, rival: str, ranked: Mapping[tuple[str, str], RankedPairs]) -> dict[str, Any]:
    """Hold the recall of `tunnelcd` at the first rate against a rival's: their difference, at least 0."""
    ours, theirs = ranked[domain, MAIN_VARIANT], ranked[domain, rival]
    rate = RATES_PER_100M[0]
    difference = recall_at(ours, rate) - recall_at(theirs, rate)
    low = high = math.nan
    if ours.pairs == theirs.pairs and np.count_nonzero(ours.n_observable) > 1:
        low, high = interval_of(resampled_recalls(ours, rate) - resampled_recalls(theirs, rate))
    name = f"recall at {rate:g} false, less that of {rival}"
    return _target(name, domain, (difference, low, high), "at least", 0.0, len(ours.pairs))


def _unchanged_targets(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Judge silence over all unchanged pairs of a run, where these are long enough to tell."""
    own = table[table["variant"] == MAIN_VARIANT]
    if len(own) == 0:
        return []
    row = _named(own.to_dict("records")[-1])  # the row over all domains, or the only one
    domain, n = str(row["domain"]), int(row["n_unchanged"])
    shares = (row["silent_share"], row["silent_low"], row["silent_high"])
    rate = (row["false_regions_per_100m_unchanged"], math.nan, math.nan)
    rows = [
        _target("share of unchanged pairs that are silent", domain, shares, "at least", _SILENT, n),
        _target("false regions per 100 m, unchanged pairs", domain, rate, "at most", _FALSE_PER_100M, n),
    ]
    if row["km_unchanged"] < LEAST_KM:
        return [{**each, "is_met": None} for each in rows]
    return rows


def _site_targets(results: pd.DataFrame) -> list[dict[str, Any]]:
    """Judge what is asked on one of the paper's sites: bytes kept by `tunnelcd`, seconds per region of `paper`."""
    found = []
    site = np.array([family.rpartition("/")[2] for family in texts(results, "family")])
    for name, asked in _BYTES.items():
        own = results[(site == name) & (results["variant"] == MAIN_VARIANT) & ~_is_unchanged(results)]
        ratios = numbers(own, "bytes_map_before") / numbers(own, "bytes_regions_before")
        value, low, high, n = mean_with_interval(ratios)
        found.append(_target("bytes of the map per byte kept", name, (value, low, high), "at least", asked, n))
    for name, asked in _T_CD_S.items():
        own = results[(site == name) & (results["variant"] == PAPER_VARIANT) & ~_is_unchanged(results)]
        seconds = numbers(own, "t_cd_per_region_s")
        values = (_median(seconds), math.nan, math.nan)
        n = int(np.count_nonzero(~np.isnan(seconds)))
        found.append({**_target("t_cd per region [s]", name, values, "at most", asked, n), "variant": PAPER_VARIANT})
    return found


def _is_unchanged(results: pd.DataFrame) -> Any:
    return results["is_unchanged_pair"].astype("boolean").fillna(value=False).to_numpy(dtype=bool)


def _target(
    name: str, domain: str, values: tuple[float, float, float], rule: str, asked: float, n: int
) -> dict[str, Any]:
    value, low, high = (float(each) for each in values)
    is_met = value >= asked - _ROUNDING if rule == "at least" else value <= asked + _ROUNDING
    return {
        "target": name,
        "domain": domain,
        "variant": MAIN_VARIANT,
        "value": value,
        "low": low,
        "high": high,
        "asked": f"{rule} {asked:g}",
        "n": int(n),
        "is_met": bool(is_met),
    }


def _named(row: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): value for key, value in row.items()}


def _mean(values: Any) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else math.nan


def _median(values: Any) -> float:
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else math.nan
