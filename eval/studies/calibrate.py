"""Thresholds at which every method has the same false-alarm rate: 5 % of the unchanged validation pairs alarm.

A preset with settings of its own for wide drifts has one threshold for each kind of site where the plan names wide
drifts; any other preset, and any variant of a plan without `wide`, has one.

Run as `python -m eval.studies.calibrate RUN`, where RUN is the folder of `tunnelcd run calibrate`. The program prints
these thresholds, and those at which every method has 0.1 false regions per 100 m. It writes both to RUN/thresholds.csv
and, in the form of presets and of plans (`thresholds`), to RUN/thresholds.yaml. Presets and plans are changed by hand,
so that none changes unnoticed.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.model.config import load_config
from cdpipe.training.shard import split_of
from eval.core.tablefile import read_table as read_stored_table
from eval.core.tablefile import table_file
from eval.core.terminal.exits import run_program
from eval.core.terminal.printing import echo
from eval.plans.coverage import read_stored_plan
from eval.report.render import write_file
from eval.running.runfolder import read_json
from eval.tables.rows import forced, records, with_pair

ALARM_SHARE = 0.05
FALSE_PER_100M = 0.1


def find_alarm_threshold(
    best_scores: Float64Array, alarm_share: float = ALARM_SHARE, lowest: float | None = None
) -> float:
    """Return the smallest threshold (four digits, rounded up) that at most `alarm_share` of the pairs reach.

    Args:
        best_scores: (P,) best candidate's score of every unchanged pair; -inf for a pair without candidates.
        alarm_share: Share of pairs that may alarm.
        lowest: Threshold of the run: lower candidates were not examined, so no lower threshold is known to hold.
    """
    if len(best_scores) == 0 or np.isnan(best_scores).any():
        raise ValueError("best_scores must hold a number for each of at least one pair")
    return _round_above(best_scores, int(alarm_share * len(best_scores)), lowest)


def find_rate_threshold(
    scores: Float64Array, path_m: float, false_per_100m: float = FALSE_PER_100M, lowest: float | None = None
) -> float:
    """Return the smallest threshold (four digits, rounded up) that at most so many false regions per 100 m reach.

    Args:
        scores: (R,) score of every candidate of all unchanged pairs.
        path_m: Summed path length of their after sessions, metres.
        false_per_100m: Largest allowed rate.
        lowest: As in `find_alarm_threshold`.
    """
    return _round_above(scores, int(false_per_100m * path_m / 100.0 + 1e-9), lowest)


def find_thresholds(results: pd.DataFrame, regions: pd.DataFrame, *, has_wide: bool = True) -> pd.DataFrame:
    """Return one row per variant and kind of site, with its thresholds at either rate.

    Where the radius belongs to a kind of site, so does the threshold: the same change scores differently in narrow and
    wide drifts. Kinds of site differ in `score_radius_m`, which is NaN for a preset that tells none apart: its
    threshold is of all pairs together. Withdrawn candidates cannot alarm. The run must therefore use a threshold below
    the one sought; no lower one is returned. A forced region that was not withdrawn alarms at every threshold; where
    there are too many, no threshold keeps the rate: it is NaN. A forced region that a better one covered in this run
    counts as the better one.

    Args:
        results: Rows of results.csv.
        regions: Rows of regions.csv.
        has_wide: Whether the plan of the run names wide drifts, for which presets may have settings of their own.

    Returns:
        `threshold`, which at most 5 % of the pairs reach, with `n_pairs`, `n_alarms` of them and `n_unanswered` others;
        `threshold_at_rate`, which at most 0.1 false regions per 100 m reach, with path length `km` and `n_false`.

    Raises:
        InputError: A seed is not of the validation split; a pair has changes, so that its alarms are not false; or no
            pair of a kind has an answer.
    """
    require_validation(results)
    changed = results.loc[results["n_changes"] > 0, "scenario"].unique()
    if len(changed):
        raise InputError(f"{', '.join(changed)}: has changes: calibration needs unchanged pairs")
    results = with_pair(results)  # a world that was not made alarms nobody
    rows = []
    kind = results["score_radius_m"].where(results["preset"].map(_tells_sites_apart) & has_wide)
    for (variant, _), cases in results.groupby(["variant", kind], sort=False, dropna=False):
        radius_m = float(kind[cases.index[0]])
        ok = cases[cases["status"] == "ok"]
        if len(ok) == 0:
            raise InputError(
                f"{variant}, {_name_kind(radius_m)}: no pair has an answer: a threshold needs at least one"
            )
        own = regions[regions["variant"] == variant]
        lowest = _find_lowest_examined(own[~forced(own)].merge(cases[["scenario", "seed"]]))
        standing = own[~own["is_withdrawn"].astype(bool)]
        standing = standing.assign(score=standing["score"].mask(forced(standing), np.inf))
        if lowest is not None:
            standing = standing[standing["score"] >= lowest]
        of_case = standing.groupby(["scenario", "seed"])["score"]
        found = {case: scores.to_numpy(dtype=np.float64) for case, scores in of_case}
        candidates = [found.get(case, np.zeros(0)) for case in zip(ok["scenario"], ok["seed"], strict=True)]
        best = np.array([scores.max(initial=-np.inf) for scores in candidates])
        every, path_m = np.concatenate(candidates), float(ok["after_path_m"].sum())
        threshold = find_alarm_threshold(best, lowest=lowest)
        at_rate = find_rate_threshold(every, path_m, lowest=lowest)
        rows.append(
            {
                "variant": variant,
                "score_radius_m": radius_m,
                "threshold": threshold,
                "n_pairs": len(ok),
                "n_alarms": int((best >= np.nan_to_num(threshold, nan=np.inf)).sum()),
                "n_unanswered": len(cases) - len(ok),
                "threshold_at_rate": at_rate,
                "km": path_m / 1000.0,
                "n_false": int((every >= np.nan_to_num(at_rate, nan=np.inf)).sum()),
            }
        )
    return pd.DataFrame(rows)


def format_settings(table: pd.DataFrame) -> str:
    """Return the thresholds in the YAML form of presets: by rate and variant, narrow or all sites, and `wide` ones.

    A comment stands where no threshold keeps the rate.
    """
    lines = []
    rates = (
        ("threshold", "{n_alarms} of {n_pairs} pairs alarm", f"at most {ALARM_SHARE:.0%} of the unchanged pairs alarm"),
        ("threshold_at_rate", "{n_false} regions in {km:g} km", f"at most {FALSE_PER_100M:g} false regions per 100 m"),
    )
    for column, standing, meaning in rates:
        lines += [f"{column}:  # {meaning}"]
        for row in records(table[table[column].isna()]):
            where = f"{row['variant']}, {_name_kind(row['score_radius_m'])}"
            lines.append(f"  # {where}: none: {standing.format(**row)} at every threshold")
        for variant, own in (
            table[table[column].notna()].sort_values("score_radius_m", kind="stable").groupby("variant", sort=False)
        ):
            first, *wider = zip(own["score_radius_m"], own[column], strict=True)
            lines += [f"  {variant}:", f"    preset: {{query: {{threshold: {first[1]:g}}}}}  # {_name_kind(first[0])}"]
            lines += [
                f"    wide_{radius_m:g}m: {{query: {{radius_m: {radius_m:g}, threshold: {value:g}}}}}"
                for radius_m, value in wider
            ]
    return "\n".join([*lines, ""])


def format_plan(table: pd.DataFrame) -> str:
    """Return the thresholds of variants with settings as a plan has them: at most 5 % of the unchanged pairs alarm.

    A comment stands where no threshold keeps the rate.
    """
    is_settings = table["variant"].str.contains("[", regex=False)
    own = table[is_settings & table["score_radius_m"].isna()]
    if not own["threshold"].notna().any():
        return ""
    lines = [
        f"  # {name}: none, too many pairs alarm at every threshold" if np.isnan(value) else f'  "{name}": {value:g}'
        for name, value in zip(own["variant"], own["threshold"] + 0.0, strict=True)  # 0 for -0
    ]
    return "\n".join(["thresholds:  # of a plan", *lines, ""])


def main(run: Annotated[Path, typer.Argument(help="folder of `tunnelcd run calibrate`")]) -> None:
    """Print and write the thresholds of a calibration run."""
    results, regions = (read_table(run / f"{name}.csv", "calibrate") for name in ("results", "regions"))
    plan = read_stored_plan(read_json(run / "provenance.json"))
    table = find_thresholds(results, regions, has_wide=plan is None or len(plan.wide) > 0)
    settings = format_settings(table) + format_plan(table)
    write_file(run / "thresholds.csv", table.to_csv(index=False))
    write_file(run / "thresholds.yaml", settings)
    echo(*table.to_string(index=False).split("\n"), "", *settings.split("\n"))


def read_table(path: Path, plan: str) -> pd.DataFrame:
    """Read a CSV of the folder of `tunnelcd run PLAN`.

    Raises:
        InputError: The file is missing, is no table, or has no rows.
    """
    expected = f"name a folder that `tunnelcd run {plan}` made"
    try:
        table = read_stored_table(table_file(path))
    except InputError as error:
        raise InputError(f"{error}: {expected}") from error
    if table.empty:
        raise InputError(f"{path}: has no rows: {expected}")
    return table


def require_validation(results: pd.DataFrame) -> None:
    """Refuse a run that settings may not be chosen on.

    Raises:
        InputError: A seed is not of the validation split.
    """
    others = [seed for seed in results["seed"].unique().tolist() if split_of(int(seed)) != "validation"]
    if others:
        raise InputError(f"seed {others[0]}: settings are chosen on seeds 10000 to 19999 alone: run the plan on those")


@cache
def _tells_sites_apart(preset: str) -> bool:
    """Return whether a preset has other settings for wide drifts, as one of a file that is not at hand may have."""
    try:
        return load_config(preset) != load_config(preset, site="wide")
    except InputError:
        return True


def _name_kind(score_radius_m: float) -> str:
    return "all sites" if np.isnan(score_radius_m) else f"{score_radius_m:g} m"


def _find_lowest_examined(regions: pd.DataFrame) -> float | None:
    """Return the lowest score that was withdrawn, so examined; None for a method that withdraws nothing.

    Reported regions do not tell: one that an object was followed to is reported whatever its score.
    """
    is_withdrawn = regions["is_withdrawn"].astype(bool)
    return float(regions.loc[is_withdrawn, "score"].min()) if is_withdrawn.any() else None


def _round_above(scores: Float64Array, allowed: int, lowest: float | None) -> float:
    """Return the smallest number of four digits, `lowest` (0 if None) or more, that at most `allowed` scores reach.

    NaN if more scores are infinite.
    """
    silent_best = -np.inf if allowed >= len(scores) else np.sort(scores)[::-1][allowed]
    if lowest is not None:
        silent_best = max(silent_best, np.nextafter(lowest, -np.inf))
    if np.isinf(silent_best):
        return 0.0 if silent_best < 0 else float("nan")
    digits = 4 - int(np.floor(np.log10(max(abs(float(silent_best)), 1e-12)))) - 1
    threshold = float(np.ceil(silent_best * 10.0**digits) / 10.0**digits)
    return threshold if threshold > silent_best else float(round(threshold + 10.0**-digits, digits))


if __name__ == "__main__":
    run_program(main, "eval.studies.calibrate")
