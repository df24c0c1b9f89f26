"""What a setting of the world does to a method: the same seeds with it and without it, and the mean of the differences.

A world `narrow[sensor.range_noise=false]` is compared with `narrow` in the same folder, and so is `dust/narrow`
(`find_references`). A seed draws the same tunnel, the same changes and the same drives in both, so each pair is its own
control.
"""

from __future__ import annotations

from typing import Any

import pandas as pd

from eval.core.statistics import IDENTITY_COLUMNS, paired_difference
from eval.plans.worlds import find_references, list_settings_over
from eval.tables.rows import numbers

KEYS = ("scenario", "variant", "seed")
COLUMNS = ("reference", "settings", "variant", "metric", "without", "with", "difference", "low", "high", "n")


def effects(results: pd.DataFrame, seed: int = 0) -> pd.DataFrame:
    """Return what each world's settings do to every figure of each variant.

    Args:
        results: Rows as in results.csv.
        seed: Seed of the bootstrap.

    Returns:
        One row per world and variant with a reference, and metric: `reference`, the other world; `settings`, what
        the world has on top of it; the means `without` and `with` them, their `difference` (with - without) and its
        95 % bootstrap interval `low` to `high`; all over the `n` seeds that have a number in both worlds, NaN where
        there is none. Times are left out: they say more about the machine. Without such worlds there is no row.
    """
    metrics = [name for name in results.columns if name not in IDENTITY_COLUMNS and not name.startswith("t_")]
    figures = results[metrics].apply(pd.to_numeric, errors="coerce").set_index(results["seed"])
    cases = dict(list(figures.groupby([results["scenario"].to_numpy(), results["variant"].to_numpy()])))
    rows: list[dict[str, Any]] = []
    found = find_references(zip(*(results[name] for name in KEYS), strict=True), has_families=True)
    for (world, variant), reference in found.items():
        changed, plain = cases[world, variant].align(cases[reference, variant], join="inner", axis=0)
        names = {"reference": reference, "settings": list_settings_over(world, reference), "variant": variant}
        rows += [
            {**names, "metric": metric, **paired_difference(numbers(plain, metric), numbers(changed, metric), seed)}
            for metric in metrics
        ]
    columns = {"mean_a": "without", "mean_b": "with", "n_used": "n"}
    return pd.DataFrame(rows).rename(columns=columns).reindex(columns=list(COLUMNS))
