"""The tables of a run and of a comparison, as the command line prints them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from eval.core.terminal.printing import LINE, MET, count_pairs, echo, echo_wrapped, print_fitted, print_row, print_table

if TYPE_CHECKING:
    import pandas as pd

    from eval.report.comparing.page import Comparison

    _Table = tuple[str, pd.DataFrame, Sequence[Sequence[str]]]  # title, rows, columns that give way


def _each(*names: str) -> tuple[tuple[str], ...]:
    return tuple((name,) for name in names)


# column of results.csv -> its heading in a table of 80 columns
_SHOWN = {
    "region_recall": "recall", "region_precision": "precision", "region_recall_at_k": "at K", "n_regions": "regions",
    "object_iou_point": "IoU", "object_f1_50": "F1@50", "merge_error_m": "merge [m]", "t_total_s": "time [s]",
}  # fmt: skip
# what gives way first where a table of 80 columns has too many
_MEANS_GIVE_WAY = _each("at K", "regions", "precision", "time [s]", "merge [m]", "failed")
_MERGE_GIVES_WAY = (
    *_each("error_m_p95", "p95_over_0.5m"), ("low", "high"),
    *_each("met", "target", "error_deg", "t_merge_s", "failed", "refused", "accepted"),
)  # fmt: skip
_REGIONS_GIVE_WAY = (
    *_each("t_desc/kf", "bytes 1/"), ("silent", "of", "km"), ("low ", "high "), ("pooled",), ("low", "high"),
    *_each("t_cd/region", "precision", "recall_at_k", "failed", "recall@0.1", "auroc"),
)  # fmt: skip
_OBJECTS_GIVE_WAY = (
    *_each("of that returns", "t_oe/region"), ("partial", "of  "), ("pile_vol", "of "), ("moved_m", "of"),
    *_each("voxel", "false_prop", "recall_prop", "kind", "matched", "f1@25", "changes", "failed", "false", "recall"),
)  # fmt: skip
_GROUPS_GIVE_WAY = (*_each("volume", "moved_m", "matched", "kind"), ("low", "high"), ("pairs",))
_TARGETS_GIVE_WAY = (("low", "high"), ("n",))
_COMPARISON_GIVES_WAY = _each("pairs", "95 % interval", "A", "B")
_MAX_LINES = 60
_MAX_ROWS = 15
_SUMMARY_LINES = 24
_MAX_NOTES = 2
_OF_A_PAIR = (
    "variant", "status", "n_changes", "n_observable", "region_recall", "region_precision", "false_regions_per_100m",
    "region_recall_at_k", "region_auroc", "n_regions", "object_iou_point", "object_f1_25", "object_f1_50",
    "kind_accuracy", "displacement_error_m", "surface_recall", "surface_level_median_m", "merge_error_m",
    "merge_error_deg", "t_merge_s", "t_total_s", "t_total_with_merge_s",
)  # fmt: skip


def print_results(folder: Path, quiet: bool, *, wide: bool = False) -> None:
    """Print means over pairs, and the tables that the plan of a run asks for, in 80 columns unless wide."""
    if quiet:
        return
    printer = _Printer(wide=wide)
    tables, notes = _gather_means(folder, wide=wide)
    for table in tables:
        printer.print(*table)
    echo(*chain.from_iterable((note, "") for note in notes))
    if (folder / "regions_table.csv").is_file():
        _region_results(folder, printer)
    if (folder / "objects_table.csv").is_file():
        _object_results(folder, printer)
    if printer.left_out:
        echo_wrapped(f"left out: {', '.join(printer.left_out)}; --wide shows all, {_name_files(folder)}", LINE)


def print_summary(folder: Path) -> None:
    """Print of a run what 24 lines hold: means over pairs, what they lack, and where the rest is."""
    tables, notes = _gather_means(folder, wide=False)
    if len(notes) > _MAX_NOTES:
        notes = [*notes[:_MAX_NOTES], f"and {len(notes) - _MAX_NOTES} more notes"]
    notes.append(f"--wide prints all tables; {_name_files(folder)}")
    lines = [line for note in notes for line in wrap(note, LINE, break_on_hyphens=False)]
    printer = _Printer(max_lines=max((_SUMMARY_LINES - len(lines)) // len(tables), 0))
    for table in tables:
        printer.print(*table)
    echo(*lines)


def print_pair_row(row: dict[str, Any], *, wide: bool) -> None:
    """Print the scores of one answer: the main ones, and how many more there are; or all."""
    shown = {name: row[name] for name in _OF_A_PAIR if name in row}
    if wide or row.get("error"):
        shown = row if wide else {**shown, "error": row["error"]}
    print_row(shown)
    if len(shown) < len(row):
        echo(f"{len(row) - len(shown)} more figures: --wide, --json or --out FILE.json")


class _Printer:
    """Prints tables in full, or what of them 80 columns hold, and remembers what they do not."""

    def __init__(self, *, wide: bool = False, max_lines: int = 0) -> None:
        self.is_wide = wide
        self.left_out: dict[str, None] = {}
        self._max_lines = max_lines

    def print(self, title: str, table: pd.DataFrame, gives_way: Sequence[Sequence[str]]) -> None:
        if self.is_wide:
            print_table(title, table)
            return
        names = print_fitted(title, table, gives_way, self._max_lines)
        self.left_out.update(dict.fromkeys(name.strip() for name in names))


def _gather_means(folder: Path, *, wide: bool) -> tuple[list[_Table], list[str]]:
    """Return the means and the merges, then what of the plan is missing and which methods lack answers."""
    import pandas as pd

    from eval.plans.coverage import measure_coverage
    from eval.plans.targets import read_targets
    from eval.running.predictions import list_incomplete_variants
    from eval.running.runfolder import RunFolder
    from eval.tables.merge_table import merge_overview
    from eval.tables.rows import without_costs_of_failures

    results = without_costs_of_failures(pd.read_csv(folder / "results.csv"))
    cases = zip(results["scenario"], results["seed"].astype(int), results["variant"], strict=True)
    provenance = RunFolder(folder).stored_provenance()
    covered = measure_coverage(provenance, cases)
    tables = [_tabulate_means(results, wide=wide)]
    merges = merge_overview(results, read_targets(provenance), is_whole=covered.is_whole)
    if len(merges):
        title = "merge: share of the pairs within the target of their kind, with its 95 % interval"
        tables.append((title, merges, _MERGE_GIVES_WAY))
    notes = [*([] if covered.is_whole else [covered.sentence]), *_tell_unmade(results)]
    return tables, [*notes, *(f"note: {line}" for line in list_incomplete_variants(provenance, results))]


def _tell_unmade(results: pd.DataFrame) -> Iterator[str]:
    """Yield how many pairs could not be made, and why the first could not."""
    from eval.tables.rows import PAIR, texts, with_pair

    # without a single pair there is no such column
    left = results.drop(with_pair(results).index) if "n_observable" in results else results[results["status"] != "ok"]
    if not len(left):
        return
    n_pairs, n_all = len(left[PAIR].drop_duplicates()), len(results[PAIR].drop_duplicates())
    first, reason = left.iloc[0], texts(left, "error")[0]
    yield (
        f"note: {n_pairs} of {count_pairs(n_all)} could not be made and {'is' if n_pairs == 1 else 'are'} in no mean: "
        f"{first['scenario']} {first['seed']}: {reason}"
    )


def _tabulate_means(results: pd.DataFrame, *, wide: bool) -> _Table:
    """Return the means over pairs: a row is a scenario and a method or, where those are many and not wide, a method."""
    groups = results.groupby(["scenario", "variant"], sort=False)
    title = "means over pairs"
    if not wide and groups.ngroups > _MAX_ROWS and results["scenario"].nunique() > 1:
        groups = results.groupby(["variant"], sort=False)
        title = f"means over the pairs of all {results['scenario'].nunique()} scenarios"
    counts = groups["status"].agg(n="size", n_failed=lambda status: (status != "ok").sum())
    # a run that ends at the merge has nothing in the columns of what comes later
    shown = [name for name in _SHOWN if name in results.columns and results[name].notna().any()]
    table = counts.join(groups[shown].mean()).reset_index()
    if wide:
        return title, table, ()
    short = table.rename(columns={**_SHOWN, "n_failed": "failed"})
    texts = {_SHOWN[name]: [_shorten(value) for value in table[name]] for name in shown}
    return title, short.assign(**texts), _MEANS_GIVE_WAY


def _shorten(value: float) -> str:
    return "-" if value != value else f"{value:.3g}"  # noqa: PLR0124 - NaN alone differs from itself


def _name_files(folder: Path) -> str:
    """Return where the tables of a run lie."""
    names = ("results", "summary", "regions_table", "objects_table", "objects_by_group", "surface_table")
    return f"{folder}: {', '.join(f'{name}.csv' for name in names if (folder / f'{name}.csv').is_file())}"


def _region_results(folder: Path, printer: _Printer) -> None:
    import pandas as pd

    from eval.tables.regions.table import region_overview

    printer.print(
        "regions: means over pairs, in and out of distribution; recall@0.1 is at 0.1 false regions per 100 m",
        region_overview(pd.read_csv(folder / "regions_table.csv")),
        _REGIONS_GIVE_WAY,
    )
    _targets(folder, "regions", printer)


def _object_results(folder: Path, printer: _Printer) -> None:
    import pandas as pd

    from eval.tables.groups import group_overview
    from eval.tables.object_table import object_overview

    table = pd.read_csv(folder / "objects_table.csv")
    printer.print(
        "objects: means over pairs, missed ones 0; matched: median IoU of those matched; moved_m, pile_vol: median "
        "error; recall and false regions per 100 m as proposed, and after withdrawal; seconds per proposed region",
        object_overview(table),
        _OBJECTS_GIVE_WAY,
    )
    if (folder / "objects_by_group.csv").is_file():
        groups = group_overview(pd.read_csv(folder / "objects_by_group.csv"), str(table["variant"].iloc[0]))
        title = f"objects of {table['variant'].iloc[0]}, by kind of prop and by hull; volume: median error"
        printer.print(title, groups, _GROUPS_GIVE_WAY)
    _targets(folder, "objects", printer)


def print_comparison(found: Comparison) -> None:
    """Print what moved between two runs, and the sentences about it."""
    from eval.report.comparing.page import MOVED, overview, sentences

    table = overview(found.table)
    title = f"A: {found.names[0]}; B: {found.names[1]}; means over session pairs, B - A pair by pair"
    if len(table) > _MAX_LINES:
        title += f"; {len(table)} figures compared, those that moved"
        table = table[table["B is"].isin(MOVED)]
    if len(table):
        print_fitted(title, table, _COMPARISON_GIVES_WAY)
    for line in sentences(found):
        echo(line)


def _targets(folder: Path, subject: str, printer: _Printer) -> None:
    import pandas as pd

    path = folder / f"{subject}_targets.csv"
    if path.is_file():
        targets = pd.read_csv(path)
        met = [MET[None if pd.isna(value) else bool(value)] for value in targets["is_met"]]
        table = targets.drop(columns="is_met").assign(met=met)
        printer.print(f"{subject}: what is asked", table, _TARGETS_GIVE_WAY)
