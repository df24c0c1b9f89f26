"""What a setting of the world does to a method: the same seeds with it and without it, and the mean of the differences.

A world `narrow[sensor.range_noise=false]` is held against `narrow` of the same run (`eval.worlds.references`). A seed
draws the same tunnel, the same changes and the same drives in both, so each pair is its own control.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from eval.statistics import IDENTITY_COLUMNS, mean_with_interval
from eval.worlds import references, settings_over

COLUMNS = ("reference", "settings", "variant", "metric", "without", "with", "difference", "low", "high", "n")


def effects(results: pd.DataFrame, seed: int = 0) -> pd.DataFrame:
    """Return what each world's settings do to every figure of each variant.

    Args:
        results: Rows as in results.csv.
        seed: Seed of the bootstrap.

    Returns:
        One row per world with settings on top of another one, variant and metric: `reference`, the other world;
        `settings`, what it has on top; the means `without` and `with` them, their `difference` (with - without) and its
        95 % bootstrap interval `low` to `high`; all over the `n` seeds that have a number in both worlds, NaN where
        there is none. Times are left out: they say more about the machine. Without such worlds there is no row.
    """
    metrics = [name for name in results.columns if name not in IDENTITY_COLUMNS and not name.startswith("t_")]
    places = [results["scenario"], results["variant"], results["seed"]]
    numbers = results[metrics].apply(pd.to_numeric, errors="coerce").set_index(places)
    rows: list[dict[str, Any]] = []
    for world, reference in references(results["scenario"]).items():
        changed, plain = numbers.loc[world].align(numbers.loc[reference], join="inner", axis=0)
        in_both = set(changed.index.get_level_values("variant"))
        for variant in dict.fromkeys(results["variant"]):
            if variant in in_both:
                pair = plain.loc[variant], changed.loc[variant]
                names = {"reference": reference, "settings": settings_over(world, reference), "variant": variant}
                rows += [{**names, "metric": metric, **_effect(*pair, metric, seed)} for metric in metrics]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _effect(plain: pd.DataFrame, changed: pd.DataFrame, metric: str, seed: int) -> dict[str, Any]:
    without, with_ = (frame[metric].to_numpy(dtype=np.float64) for frame in (plain, changed))
    is_used = ~np.isnan(without) & ~np.isnan(with_)
    difference, low, high, n = mean_with_interval((with_ - without)[is_used], seed)
    means = (float(values[is_used].mean()) if n else float("nan") for values in (without, with_))
    found = dict(zip(("without", "with"), means, strict=True))
    return {**found, "difference": difference, "low": low, "high": high, "n": n}
