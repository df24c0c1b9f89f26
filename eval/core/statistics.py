"""Means and medians over session pairs, with 95 % intervals that draw session pairs, or whole groups of them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from cdpipe.core.ranking import auroc, average_precision

Statistic = Literal["mean", "median"]
N_RESAMPLES = 2000
# From here on a mean is a product of counts, five times as fast as a gathered sample and equal but for rounding.
MANY_PAIRS = 5000
# sign test: six pairs agree by chance in 2^(1-6) = 3 % of cases, five in 6 %
ENOUGH_PAIRS = 6
_NORMAL_95 = 1.959963984540054
IDENTITY_COLUMNS = (
    "scenario", "family", "domain", "pair_kind", "seed", "variant", "preset", "status", "error", "metrics_version",
    "score_radius_m", "odometry_before", "odometry_after", "sensor_profile", "checkpoints", "extras", "commit",
    "is_contended",
)  # fmt: skip


def summarise(
    results: pd.DataFrame,
    by: Literal["scenario", "family"] = "scenario",
    seed: int = 0,
    keyframes: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """Summarise every numeric column for each scenario (or family) and variant.

    Args:
        results: Rows as in results.csv, one per session pair and variant.
        by: What to group by, beside the variant.
        seed: Seed of the bootstrap.
        keyframes: Keyframe rows of the same pairs (score, label, and the columns that identify the pair), for AUROC
            and AP pooled over all keyframes of a group.

    Returns:
        One row per group and metric: `statistic` (median for times, else mean), `value` over all cases with its 95 %
        bootstrap interval `low` to `high`, `value_ok` over cases whose status is ok, `n` cases, `n_failed` of them not
        ok, and the counts of defined numbers (not NaN) `n_used` and `n_used_ok`.
    """
    metrics = [name for name in results.columns if name not in IDENTITY_COLUMNS]
    of_groups = {} if keyframes is None else dict(list(keyframes.groupby([by, "variant"])))
    rows: list[dict[str, Any]] = []
    for (group, variant), cases in results.groupby([by, "variant"], sort=False):
        is_ok = (cases["status"] == "ok").to_numpy()
        names = {by: group, "variant": variant}
        counts = {"n": len(cases), "n_failed": int(np.count_nonzero(~is_ok))}
        for metric in metrics:
            values = pd.to_numeric(cases[metric], errors="coerce").to_numpy(dtype=np.float64)
            rows.append({**names, "metric": metric, **_summary(metric, values, is_ok, seed), **counts})
        if keyframes is not None:
            of_group = of_groups.get((group, variant), keyframes[:0])
            rows += [{**names, **pooled, **counts} for pooled in _pooled(of_group, cases[is_ok])]
    columns = [by, "variant", "metric", "statistic", "value", "low", "high", "value_ok"]
    return pd.DataFrame(rows, columns=[*columns, "n", "n_failed", "n_used", "n_used_ok"])


def mean(values: Float64Array | BoolArray) -> float:
    """Return the mean of the numbers that are not NaN; NaN without one."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else float("nan")


def median(values: Float64Array) -> float:
    """Return the median of the numbers that are not NaN; NaN without one."""
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else float("nan")


def statistic_of(column: str) -> Statistic:
    """Return how a column is summarised over pairs: times by their median, everything else by its mean."""
    return "median" if column.startswith("t_") else "mean"


def bootstrap_interval(values: Float64Array, statistic: Statistic = "mean", seed: int = 0) -> tuple[float, float]:
    """Return the 95 % percentile interval of the mean or median of (N,) numbers, one for each session pair.

    Pairs are drawn with replacement; NaN is left out after drawing. The interval is NaN for fewer than two numbers,
    because one pair holds no information on the variation between pairs.
    """
    if np.count_nonzero(~np.isnan(values)) < 2:
        return float("nan"), float("nan")
    if statistic == "mean" and len(values) > MANY_PAIRS:
        counts, is_number = _draw_counts(seed, len(values)), ~np.isnan(values)
        return interval_of((counts @ np.where(is_number, values, 0.0)) / (counts @ is_number.astype(np.float64)))
    samples = values[_draws(seed, len(values))]
    if np.isnan(values).any():
        samples = samples[~np.isnan(samples).all(axis=1)]
        results = np.nanmean(samples, axis=1) if statistic == "mean" else np.nanmedian(samples, axis=1)
    else:
        results = samples.mean(axis=1) if statistic == "mean" else np.median(samples, axis=1)  # the same, but faster
    return interval_of(results)


def clustered_interval(values: Float64Array, group: Int64Array, statistic: Statistic = "mean") -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the mean or median of (N,) numbers; whole groups of them are drawn.

    Args:
        values: One for each item, without NaN.
        group: (N,) which pair or tunnel each is of; groups without an item are not drawn.
        statistic: Over all items of the groups that were drawn, as often as they were.

    Returns:
        NaN for fewer than two groups: one says nothing about how they vary.
    """
    _, place = np.unique(group, return_inverse=True)
    n_groups = int(place.max(initial=-1)) + 1
    if n_groups < 2:
        return float("nan"), float("nan")
    draws = stream(0, "bootstrap").integers(n_groups, size=(N_RESAMPLES, n_groups))
    if statistic == "mean":
        sums, counts = np.bincount(place, values), np.bincount(place)
        samples = sums[draws].sum(axis=1) / counts[draws].sum(axis=1)
    else:
        order = np.argsort(values, kind="stable")
        times_drawn = np.stack([np.bincount(draw, minlength=n_groups) for draw in draws])
        samples = _repeated_medians(values[order], times_drawn[:, place[order]])
    return interval_of(samples)


def interval_over_tunnels(
    values: Float64Array, tunnels: Int64Array, statistic: Statistic = "mean", seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the mean or median of (N,) numbers, one for each pair, NaN left out.

    Where (N,) `tunnels` says that pairs share one they are drawn together. NaN for fewer than two tunnels.
    """
    is_number = ~np.isnan(values)
    values, tunnels = values[is_number], tunnels[is_number]
    if len(np.unique(tunnels)) < len(tunnels):
        return clustered_interval(values, tunnels, statistic)
    return bootstrap_interval(values, statistic, seed)


def _repeated_medians(rising: Float64Array, times: Int64Array) -> Float64Array:
    """Return (B,) medians of (N,) rising numbers, each taken (B, N) times; every row takes at least one."""
    up_to = np.cumsum(times, axis=1)
    n = up_to[:, -1:]
    lower, upper = ((up_to <= rank).sum(axis=1) for rank in ((n - 1) // 2, n // 2))
    return np.asarray((rising[lower] + rising[upper]) / 2)


@lru_cache(maxsize=2)
def _draws(seed: int, n: int) -> Int64Array:
    """Return the (N_RESAMPLES, n) pairs that each bootstrap sample draws; a table asks for the same ones many times."""
    return stream(seed, "bootstrap").integers(n, size=(N_RESAMPLES, n))


@lru_cache(maxsize=1)
def _draw_counts(seed: int, n: int) -> Float64Array:
    """Return (N_RESAMPLES, n) how often each bootstrap sample of `_draws` draws each pair."""
    return np.stack([np.bincount(drawn, minlength=n) for drawn in _draws(seed, n)]).astype(np.float64)


def interval_of(samples: Float64Array) -> tuple[float, float]:
    """Return the 95 % percentile interval of bootstrap samples, NaN among them left out; NaN without a sample."""
    samples = samples[~np.isnan(samples)]
    if len(samples) == 0:
        return float("nan"), float("nan")
    low, high = np.percentile(samples, (2.5, 97.5))
    return float(low), float(high)


def mean_with_interval(values: Float64Array, seed: int = 0) -> tuple[float, float, float, int]:
    """Return mean, low and high of its 95 % bootstrap interval, and the count of the (N,) numbers that are not NaN.

    Mean and interval are NaN without a number; the interval is NaN for a single one.
    """
    values = values[~np.isnan(values)]
    low, high = bootstrap_interval(values, seed=seed)
    return mean(values), low, high, len(values)


def paired_difference(
    a: Float64Array, b: Float64Array, seed: int = 0, tunnels: Int64Array | None = None
) -> dict[str, Any]:
    """Return the mean difference b - a over the pairs that have a number on both sides.

    Args:
        a: (N,) numbers of one side, one for each session pair, NaN where undefined.
        b: (N,) numbers of the other side, for the same pairs.
        seed: Seed of the bootstrap.
        tunnels: (N,) numbers of the tunnels; pairs of one tunnel are drawn together. None: each has its own.

    Returns:
        `n_used` pairs with both numbers, of `n_tunnels` tunnels, `n_only_a` and `n_only_b` with one; over those used
        the means `mean_a` and `mean_b` and the `difference` with its 95 % interval `low` to `high`, NaN where there is
        none.
    """
    has_a, has_b = ~np.isnan(a), ~np.isnan(b)
    used = has_a & has_b
    own = (np.arange(len(a)) if tunnels is None else tunnels)[used]
    low, high = interval_over_tunnels((b - a)[used], own, seed=seed)
    return {
        "n_used": len(own), "n_tunnels": len(np.unique(own)),
        "n_only_a": int((has_a & ~has_b).sum()), "n_only_b": int((has_b & ~has_a).sum()),
        "mean_a": mean(a[used]), "mean_b": mean(b[used]), "difference": mean((b - a)[used]),
        "low": low, "high": high,
    }  # fmt: skip


def wilson_interval(n_hits: float, n: float) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of the share of `n` pairs that are hits; NaN for none.

    Unlike the bootstrap, it has a width where all pairs agree: 20 of 20 gives 0.84 to 1.
    """
    if n == 0:
        return float("nan"), float("nan")
    share, z2 = n_hits / n, _NORMAL_95**2
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = _NORMAL_95 / (1 + z2 / n) * float(np.sqrt(share * (1 - share) / n + z2 / (4 * n * n)))
    return max(centre - half, 0.0), min(centre + half, 1.0)


def _summary(
    metric: str, values: Float64Array, is_ok: np.ndarray[Any, np.dtype[np.bool_]], seed: int
) -> dict[str, Any]:
    statistic = statistic_of(metric)
    low, high = bootstrap_interval(values, statistic, seed)
    average = median if statistic == "median" else mean
    return {
        "statistic": statistic,
        "value": average(values),
        "low": low,
        "high": high,
        "value_ok": average(values[is_ok]),
        "n_used": int(np.count_nonzero(~np.isnan(values))),
        "n_used_ok": int(np.count_nonzero(~np.isnan(values[is_ok]))),
    }


def _pooled(keyframes: pd.DataFrame, ok_cases: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of AUROC and AP over all keyframes, and over those of the cases that are ok."""
    pair = ["scenario", "seed"]
    used = keyframes[keyframes["label"] >= 0]
    used_ok = used[pd.MultiIndex.from_frame(used[pair]).isin(pd.MultiIndex.from_frame(ok_cases[pair]))]
    counts = {"n_used": int(used.groupby(pair).ngroups), "n_used_ok": int(used_ok.groupby(pair).ngroups)}
    unknown = dict.fromkeys(("low", "high"), float("nan"))
    rows = []
    for name, measure in (("region_auroc", auroc), ("region_ap", average_precision)):
        value, value_ok = (
            measure(part["score"].to_numpy(dtype=np.float64), part["label"].to_numpy() == 1) for part in (used, used_ok)
        )
        told = {"metric": f"{name}_pooled", "statistic": "pooled", "value": value, "value_ok": value_ok}
        rows.append({**told, **unknown, **counts})
    return rows
