"""Thresholds of the merge's gates, from the evidence of right and wrong merges.

Run as `python -m eval.studies.merge_gates RUN --out DIR`, where RUN is the folder of `tunnelcd run merge-gates`. Its
variant sets `merge.accept_all`, so that every best hypothesis is kept with its evidence, right or wrong. The program
writes DIR/gates.csv and DIR/gates.png. Thresholds go into cdpipe/model/config/mapping.py by hand, so that none changes
unnoticed.

The search stops at the present gates even under `merge.accept_all`: the next candidate, and KISS-Matcher, are tried
only where the previous candidate misses a gate. The kept merge therefore depends on the present thresholds; new ones
are chosen from one run, without iteration.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, stream
from cdpipe.merge.evidence import GATES
from cdpipe.model.config import load_config
from eval.core.charts import BLACK, BLUE, VERMILLION, Axis, Drawing, Look, Panel, Series, log_span, named_ticks
from eval.core.figures import picture, png
from eval.core.output import make_writable
from eval.core.terminal.exits import run_program
from eval.core.terminal.printing import echo
from eval.plans.cells import expand_cells
from eval.plans.coverage import read_stored_plan
from eval.report.render import write_file
from eval.running.runfolder import read_json
from eval.studies.calibrate import read_table, require_validation
from eval.tables.merge_table import RULES, is_accepted, is_right, kinds
from eval.tables.rows import numbers, texts

KEPT_SHARE = 0.995
LOGARITHMIC = ("hessian_ratio",)
_LEAST_SHOWN = 1e-5
_MARKS = (
    (True, Look(BLUE, 0.0, marker="circle", size=3.5, opacity=0.6), "right merge", -0.2),
    (False, Look(VERMILLION, 0.0, marker="x", size=3.5, opacity=0.6), "wrong merge", 0.2),
)


def read_committed_thresholds() -> dict[str, float]:
    """Return the threshold of every gate in the preset `tunnelcd`."""
    merge = load_config("tunnelcd").merge
    return {name: float(getattr(merge, setting)) for name, setting in GATES}


def require_ungated(results: pd.DataFrame, variant: str, provenance: Mapping[str, Any]) -> None:
    """Check that no gate refused merges of a variant: thresholds chosen from the remaining merges would be biased.

    Args:
        results: Rows as in results.csv.
        variant: The variant that accepts every merge.
        provenance: Content of provenance.json.

    Raises:
        InputError: A gate refused a merge, or the variant does not set `merge.accept_all`.
    """
    refused = results[((results["variant"] == variant) & (results["status"] == "merge_refused")).to_numpy()]
    for row in refused.assign(error=texts(refused, "error")).to_dict("records"):
        named = [f"merge.{setting}" for _, setting in GATES if f"merge.{setting}" in row["error"]]
        if named:
            raise InputError(
                f"{row['scenario']}, seed {row['seed']}: refused by {named[0]}: run the plan with merge.accept_all=true"
            )
    plan = read_stored_plan(provenance)
    found = [] if plan is None else [cell.config for cell in expand_cells(plan) if cell.variant == variant]
    if not found or not all(config.merge.accept_all for config in found):
        raise InputError(
            f"provenance.json: variant {variant} is not told to have merge.accept_all=true: "
            "run a plan whose variant sets it, as `merge-gates` does"
        )


def tabulate_merges(results: pd.DataFrame, variant: str) -> pd.DataFrame:
    """Return the accepted merges of a variant with their evidence: `right`, `kind`, and a column for each gate.

    Args:
        results: Rows as in results.csv.
        variant: The variant that accepts every merge; "" where the run has only one.

    Raises:
        InputError: There is no such variant, or the table lacks the evidence.
    """
    variant = choose_variant(results, variant)
    absent = [f"evidence_{name}" for name, _ in GATES if f"evidence_{name}" not in results]
    if absent:
        raise InputError(f"results.csv: column {', '.join(absent)} is missing: `tunnelcd score` the run again")
    own = results[(results["variant"] == variant).to_numpy() & is_accepted(results)]
    return pd.DataFrame(
        {
            "scenario": own["scenario"].to_numpy(),
            "seed": own["seed"].to_numpy(),
            "kind": kinds(own),
            "right": is_right(own),
            "merge_error_m": numbers(own, "merge_error_m"),
            **{name: numbers(own, f"evidence_{name}") for name, _ in GATES},
        }
    )


def choose_variant(results: pd.DataFrame, variant: str) -> str:
    """Return the named variant, or the only one where none is named.

    Raises:
        InputError: There is no such variant, or none is named and there are several.
    """
    names = list(dict.fromkeys(results["variant"].astype(str)))
    if not variant and len(names) == 1:
        return names[0]
    if variant not in names:
        raise InputError(f"--variant {variant or '(none)'}: name one of the run's: {', '.join(names)}")
    return variant


def tabulate_gates(cases: pd.DataFrame, thresholds: Mapping[str, float]) -> pd.DataFrame:
    """Return one row for every gate and one for all of them together.

    Args:
        cases: As `tabulate_merges` returns them.
        thresholds: Threshold of each gate.

    Returns:
        `gate`, `setting`, `threshold`; `n_right`, `n_wrong`; `worst_right` and `best_wrong`, the lowest value of a
        right merge and the highest of a wrong one; how many of each the gate refuses, and how many no other gate
        refuses (`..._alone`); `is_separable` and the `suggested` threshold: the middle between worst right and best
        wrong (in logarithms, for a ratio), or else the value that keeps 99.5 % of the right merges. The row `all`
        counts the merges that at least one gate refuses. Undefined evidence is refused.
    """
    right = cases["right"].to_numpy(dtype=np.bool_)
    refused = {name: ~(cases[name].to_numpy(dtype=np.float64) >= thresholds[name]) for name, _ in GATES}
    rows: list[dict[str, Any]] = []
    for name, setting in GATES:
        by_others = np.logical_or.reduce([mask for other, mask in refused.items() if other != name])
        values = cases[name].to_numpy(dtype=np.float64)
        suggested, is_separable = suggest_threshold(values[right], values[~right], logarithmic=name in LOGARITHMIC)
        rows.append(
            {
                "gate": name,
                "setting": f"merge.{setting}",
                "threshold": thresholds[name],
                **_count_refused(right, refused[name], refused[name] & ~by_others),
                "worst_right": _find_extreme(values[right], np.min),
                "best_wrong": _find_extreme(values[~right], np.max),
                "is_separable": is_separable,
                "suggested": suggested,
            }
        )
    every = np.logical_or.reduce(list(refused.values()))
    nothing = np.zeros_like(every)
    return pd.DataFrame([*rows, {"gate": "all", "setting": "", **_count_refused(right, every, nothing)}])


def pass_gates(cases: pd.DataFrame, thresholds: Mapping[str, float]) -> BoolArray:
    """Return the (N,) mask of the merges that reach every gate."""
    passed = [cases[name].to_numpy(dtype=np.float64) >= thresholds[name] for name, _ in GATES]
    return np.asarray(np.logical_and.reduce(passed), dtype=np.bool_)


def suggest_threshold(right: Float64Array, wrong: Float64Array, *, logarithmic: bool) -> tuple[float, bool]:
    """Return a threshold, and whether it separates all right values from all wrong ones.

    The threshold is rounded down to three digits; it is NaN without a right value.
    """
    right, wrong = right[~np.isnan(right)], wrong[~np.isnan(wrong)]
    if len(right) == 0:
        return float("nan"), False
    if len(wrong) and wrong.max() < right.min():
        low, high = float(wrong.max()), float(right.min())
        middle = float(np.sqrt(low * high)) if logarithmic and low > 0 else (low + high) / 2
        rounded = _round_down(middle)
        return (rounded if rounded > low else middle), True
    return _round_down(float(np.sort(right)[int((1.0 - KEPT_SHARE) * len(right))])), False


def draw_gates(cases: pd.DataFrame, table: pd.DataFrame) -> Drawing:
    """Draw a panel for each gate: every merge by kind of pair, right and wrong, and the thresholds."""
    by_gate = {str(row["gate"]): row for row in table.to_dict("records")}
    kinds_shown = [kind for kind in (*RULES, "") if (cases["kind"] == kind).any()]
    y_span = (len(kinds_shown) - 0.5, -0.5)
    y = Axis(span=y_span, ticks=named_ticks([kind or "no kind" for kind in kinds_shown]))
    panels = []
    for name, setting in GATES:
        gate, suggested = by_gate[name]["threshold"], by_gate[name]["suggested"]
        lines = [Series([gate, gate], y_span, Look(BLACK), "gate")]
        if not np.isnan(suggested):
            lines.append(Series([suggested, suggested], y_span, Look(BLACK, 1.0, "dash"), "suggested"))
        marks = [
            series
            for row, kind in enumerate(kinds_shown)
            for series in _draw_marks(cases[cases["kind"] == kind], name, row)
        ]
        drawn = np.concatenate([np.ravel(each.x) for each in (*lines, *marks)])
        span = log_span(drawn) if name in LOGARITHMIC else None
        x = Axis(f"{name.replace('_', ' ')}, merge.{setting}", span, is_log=name in LOGARITHMIC)
        panels.append(Panel(x, y, [*marks, *lines], f"gate at {gate:g}"))
    n_across = -(-len(GATES) // 2)
    return Drawing([panels[:n_across], panels[n_across:]], 260)


def main(
    run: Annotated[Path, typer.Argument(help="folder of `tunnelcd run merge-gates`")],
    out: Annotated[Path, typer.Option("--out", help="folder for gates.csv and gates.png", show_default=False)],
    variant: Annotated[str, typer.Option(help="variant that accepts every merge, if the run has several")] = "",
) -> None:
    """Print, write and draw which merges of a validation run each gate accepts and refuses."""
    path = run / "results.csv"
    results = read_table(path, "merge-gates")
    require_validation(results)
    require_ungated(results, choose_variant(results, variant), read_json(run / "provenance.json"))
    cases, thresholds = tabulate_merges(results, variant), read_committed_thresholds()
    if len(cases) == 0:
        raise InputError(f"{path}: no merge was accepted: the plan's variant must set merge.accept_all=true")
    make_writable(out)
    table = tabulate_gates(cases, thresholds)
    write_file(out / "gates.csv", table.to_csv(index=False))
    write_file(out / "gates.png", png(picture(draw_gates(cases, table))))
    echo(*table.to_string(index=False, na_rep="-").split("\n"), "")
    n_other = len(results) - len(cases)
    echo(f"{len(cases)} merges; {n_other} further rows of results.csv were not merged or are of other variants")
    passed, right = pass_gates(cases, thresholds), cases["right"].to_numpy(dtype=np.bool_)
    for title, mask in (("wrong, but let through", passed & ~right), ("right, but refused", right & ~passed)):
        echo("", f"{title}: {int(mask.sum())}")
        if mask.any():
            echo(*cases[mask].drop(columns="right").to_string(index=False, na_rep="-").split("\n"))


def _count_refused(right: BoolArray, refused: BoolArray, alone: BoolArray) -> dict[str, int]:
    return {
        "n_right": int(right.sum()),
        "n_wrong": int((~right).sum()),
        "n_right_refused": int((refused & right).sum()),
        "n_right_refused_alone": int((alone & right).sum()),
        "n_wrong_refused": int((refused & ~right).sum()),
        "n_wrong_refused_alone": int((alone & ~right).sum()),
        "n_wrong_let_through": int((~refused & ~right).sum()),
    }


def _find_extreme(values: Float64Array, which: Any) -> float:
    values = values[~np.isnan(values)]
    return float(which(values)) if len(values) else float("nan")


def _round_down(value: float) -> float:
    if value <= 0:
        return value
    digits = 2 - int(np.floor(np.log10(value)))
    # 0.29 * 100 is a hair below 29
    return float(np.floor(value * 10.0**digits + 1e-9) / 10.0**digits)


def _draw_marks(cases: pd.DataFrame, name: str, row: int) -> list[Series]:
    """Return the right and the wrong merges of one kind of pair; evidence that is missing is drawn at 0."""
    found = []
    for is_right_merge, look, word, offset in _MARKS:
        values = np.nan_to_num(cases[name].to_numpy(dtype=np.float64)[cases["right"] == is_right_merge], nan=0.0)
        values = np.maximum(values, _LEAST_SHOWN) if name in LOGARITHMIC else values
        shifts = stream(0, "gates", "strip").uniform(-0.13, 0.13, len(values))
        found.append(Series(values, row + offset + shifts, look, word))
    return found


if __name__ == "__main__":
    run_program(main, "eval.studies.merge_gates")
