"""Sets the threshold of every method to the same false-alarm rate: 5 % of unchanged validation pairs alarm.

Run as `python -m eval.calibrate RUN`, where RUN is the folder of `tunnelcd run calibrate`. The thresholds are printed
and written to RUN/thresholds.csv; they go into the presets by hand, so that no preset changes behind anyone's back.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from cdpipe.errors import InputError
from cdpipe.geometry import Float64Array
from eval.cli import input_errors

ALARM_SHARE = 0.05


def alarm_threshold(best_scores: Float64Array, alarm_share: float = ALARM_SHARE) -> float:
    """Return the smallest threshold, rounded up to four digits, that at most `alarm_share` of the pairs reach.

    Args:
        best_scores: (P,) best candidate's score of every unchanged pair; -inf for a pair without candidates.
        alarm_share: Share of pairs that may alarm.
    """
    if len(best_scores) == 0 or np.isnan(best_scores).any():
        raise ValueError("best_scores must hold a number for each of at least one pair")
    allowed = int(alarm_share * len(best_scores))
    silent_best = np.sort(best_scores)[::-1][allowed]
    if np.isinf(silent_best):
        return 0.0
    digits = 4 - int(np.floor(np.log10(max(abs(float(silent_best)), 1e-12)))) - 1
    threshold = float(np.ceil(silent_best * 10.0**digits) / 10.0**digits)
    return threshold if threshold > silent_best else float(round(threshold + 10.0**-digits, digits))


def thresholds(results: pd.DataFrame, regions: pd.DataFrame) -> pd.DataFrame:
    """Return one row per variant and scenario: threshold, pairs, pairs that alarm at it, pairs without an answer.

    A threshold belongs to a kind of site, as the radius does: what is much change in a narrow drift is little in a
    wide one.

    Raises:
        InputError: A pair has changes, so that its alarms would not be false.
    """
    changed = results.loc[results["n_changes"] > 0, "scenario"].unique()
    if len(changed):
        raise InputError(f"{', '.join(changed)}: has changes: calibration needs unchanged pairs")
    best = regions.groupby(["variant", "scenario", "seed"])["score"].max()
    rows = []
    for (variant, scenario), cases in results.groupby(["variant", "scenario"], sort=False):
        ok = cases[cases["status"] == "ok"]
        scores = np.array([best.get((variant, scenario, seed), -np.inf) for seed in ok["seed"]], dtype=np.float64)
        threshold = alarm_threshold(scores)
        n_alarms = int((scores >= threshold).sum())
        rows.append((variant, scenario, threshold, len(ok), n_alarms, len(cases) - len(ok)))
    return pd.DataFrame(rows, columns=["variant", "scenario", "threshold", "n_pairs", "n_alarms", "n_unanswered"])


def main(run: Annotated[Path, typer.Argument(help="folder of `tunnelcd run calibrate`")]) -> None:
    """Print and write the thresholds of a calibration run."""
    table = thresholds(_read(run / "results.csv"), _read(run / "regions.csv"))
    table.to_csv(run / "thresholds.csv", index=False)
    typer.echo(table.to_string(index=False))


def _read(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: {reason}: name a folder that `tunnelcd run calibrate` made") from error


if __name__ == "__main__":
    with input_errors():
        typer.run(main)
