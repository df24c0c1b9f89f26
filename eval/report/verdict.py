"""The first paragraph about a run of many methods on many pairs: who wins where, by how much and at what cost.

Every margin is paired: the difference between the best method and the next is taken pair by pair, with a bootstrap
interval over pairs. Where a simple baseline wins, that is said first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.core.statistics import mean_with_interval
from eval.report.comparing import BETTER, verdict
from eval.report.cost.pareto import BYTES, TIME, comparable
from eval.report.objects.tables import is_told_the_truth
from eval.report.story import about_failures, about_grids, about_repeated, about_size, about_wrong_merges, joined
from eval.running.run_data import BASELINES, RunData, flag, is_unchanged, number, scenarios, split_variant, text
from eval.running.sides import is_contended
from eval.tables.columns import RESULT_COLUMNS, Column, share, significant, spaced
from eval.tables.merge_table import numbers
from eval.tables.region_curves import PAIR
from eval.tables.region_table import DOMAINS, MAIN_VARIANT

_KEYS = ("region_recall", "region_auroc", "object_iou_point")
_COLUMNS = [column for key in _KEYS for column in RESULT_COLUMNS if column.key == key]
_KILOBYTE = 1000.0
_OTHER_MERGES = frozenset({"frame", "kiss-matcher"})
_PAPER = "paper"


@dataclass(frozen=True, slots=True)
class Win:
    """Who is best at one figure in one domain.

    Attributes:
        domain: Where.
        column: The figure.
        winners: Methods that share the best mean, as written.
        best: That mean.
        second: The best of the others, "" without one.
        mean_of_second: Its mean.
        difference: Mean over pairs of the first winner less the second, with its 95 % interval `low` to `high`.
        n_pairs: Over how many pairs that is.
        is_clear: Whether the interval leaves out 0 and enough pairs stand behind it.
    """

    domain: str
    column: Column
    winners: tuple[str, ...]
    best: float
    second: str
    mean_of_second: float
    difference: float
    low: float
    high: float
    n_pairs: int
    is_clear: bool


def is_judged(data: RunData) -> bool:
    """Tell whether a run holds two methods or more, and a scenario with changes and several pairs."""
    worlds = scenarios(data, unchanged=False)
    cases = comparable(data)
    if not worlds or not len(cases):
        return False
    seeds = cases[cases["scenario"].isin(worlds)].groupby("scenario")["seed"].nunique()
    return bool(len(seeds) and seeds.max() > 1 and len(contenders(cases)) > 1)


def verdict_sentences(data: RunData) -> list[str]:
    """Return the sentences; `is_judged` says whether there is something to tell."""
    cases = comparable(data)
    names = contenders(cases)
    changed = cases[cases["scenario"].isin(scenarios(data, unchanged=False))]
    found = wins(changed[changed["variant"].isin(names)])
    told = [*(_told(win, changed) for win in found), *_about_costs(found, changed)]
    alone = _about_baselines(found, names)
    wrong = about_wrong_merges(data)
    contended = ["Times were measured beside other work."] if is_contended(data) else []
    return [
        *alone, *_tally(found), *told, *about_grids(data), *contended, *_about_silence(data, names), *wrong,
        *about_failures(data), about_size(data), *about_repeated(data),
    ]  # fmt: skip


def contenders(cases: pd.DataFrame) -> list[str]:
    """Return the methods that compete: not told the truth, and with no setting of their own where plain ones are.

    Nor does ours behind another merge, where it stands itself: that it comes second says nothing about rivals.
    """
    names = [str(name) for name in dict.fromkeys(cases["variant"]) if not is_told_the_truth(str(name))]
    if MAIN_VARIANT in names:
        names = [name for name in names if split_variant(name)[0] not in _OTHER_MERGES]
    plain = [name for name in names if not split_variant(name)[1]]
    return plain if len(plain) > 1 else names


def wins(cases: pd.DataFrame) -> list[Win]:
    """Return who is best at each figure in each domain, among methods with as many pairs as any.

    Args:
        cases: Rows of results.csv of pairs with changes and of methods that compete, with their `domain`.
    """
    found = []
    for domain in [name for name in DOMAINS if (cases["domain"] == name).any()]:
        own = cases[cases["domain"] == domain]
        sizes = own.groupby("variant", sort=False).size()
        full = [str(name) for name in sizes.index if sizes[name] == sizes.max()]
        for column in _COLUMNS:
            if column.key not in own:
                continue
            values = {name: _by_pair(own[own["variant"] == name], column.key) for name in full}
            means = {name: float(each.mean()) for name, each in values.items() if each.notna().any()}
            if means:
                found.append(_win(domain, column, values, means))
    return found


def _win(domain: str, column: Column, values: dict[str, pd.Series], means: dict[str, float]) -> Win:
    written = {name: round(mean, 2) for name, mean in means.items()}
    top = max(written.values())
    winners = tuple(name for name, value in written.items() if value == top)
    others = {name: mean for name, mean in means.items() if name not in winners}
    second = max(others, key=lambda name: others[name]) if others else ""
    if not second:
        return Win(domain, column, winners, top, "", math.nan, math.nan, math.nan, math.nan, 0, False)
    first = max(winners, key=lambda name: means[name])
    difference = (values[first] - values[second]).to_numpy(dtype=np.float64)
    mean, low, high, n = mean_with_interval(difference)
    is_clear = verdict("high", n, mean, (low, high)) == BETTER
    return Win(domain, column, winners, top, second, written[second], mean, low, high, n, is_clear)


def _by_pair(own: pd.DataFrame, key: str) -> pd.Series:
    index = pd.MultiIndex.from_frame(own[PAIR])
    return pd.Series(numbers(own, key), index=index)


def _told(win: Win, cases: pd.DataFrame) -> str:
    where = f"{domain_name(win.domain).capitalize()}, {win.column.heading}:"
    if win.best <= 0:
        return f"{where} no method gets above 0."
    verb = "is best with" if len(win.winners) == 1 else "tie at"
    words = f"{where} {joined([spaced(name) for name in win.winners])} {verb} {share(win.best)}"
    if not win.second:
        return f"{words}; nothing else was run."
    margin = f"{share(win.best - win.mean_of_second)} ahead of {spaced(win.second)} ({share(win.mean_of_second)})"
    sure = f"over {win.n_pairs} pairs"
    if not math.isnan(win.low):
        sure = f"pair by pair {_signed(win.low)} to {_signed(win.high)} {sure}"
    noise = "" if win.is_clear else ", no more than chance could do"
    return f"{words}, {margin}; {sure}{noise}.{_of_the_paper(win, cases)}{_false_regions(win, cases)}"


def _of_the_paper(win: Win, cases: pd.DataFrame) -> str:
    """Say where the paper's method stands, which all of this began with."""
    values = numbers(cases[(cases["domain"] == win.domain) & (cases["variant"] == _PAPER)], win.column.key)
    if _PAPER in (*win.winners, win.second) or not (~np.isnan(values)).any():
        return ""
    return f" The paper's method: {share(float(np.nanmean(values)))}."


def _about_costs(found: Sequence[Win], cases: pd.DataFrame) -> list[str]:
    """Say in one sentence for each domain what a pair costs with the methods that were named."""
    told = []
    for domain in dict.fromkeys(win.domain for win in found):
        own = [win for win in found if win.domain == domain]
        names = dict.fromkeys(name for win in own for name in (*win.winners, win.second) if name)
        costs = [f"{spaced(name)} {cost}" for name in names if (cost := _cost(cases, domain, name))]
        if costs:
            told.append(f"{domain_name(domain).capitalize()}, a pair costs: {'; '.join(costs)}.")
    return told


def _cost(cases: pd.DataFrame, domain: str, name: str) -> str:
    """Return median seconds and mean kilobytes kept of the before map, "" where neither is known."""
    own = cases[(cases["domain"] == domain) & (cases["variant"] == name) & (cases["status"] == "ok")]
    seconds, kept = numbers(own, TIME), numbers(own, BYTES)
    parts = []
    if (~np.isnan(seconds)).any():
        parts.append(f"{significant(float(np.nanmedian(seconds)))} s")
    if (~np.isnan(kept)).any():
        parts.append(f"{significant(float(np.nanmean(kept)) / _KILOBYTE)} kB kept")
    return " and ".join(parts)


def _false_regions(win: Win, cases: pd.DataFrame) -> str:
    """Say how many false regions come with a recall: alone it rewards reporting everything."""
    if win.column.key != "region_recall":
        return ""
    shown = []
    for name in (*win.winners, win.second):
        own = cases[(cases["domain"] == win.domain) & (cases["variant"] == name)]
        rates = numbers(own, "false_regions_per_100m")
        if (~np.isnan(rates)).any():
            shown.append(f"{spaced(name)} {share(float(np.nanmean(rates)))}")
    return f" False regions per 100 m: {', '.join(shown)}." if shown else ""


def _about_baselines(found: Sequence[Win], names: Sequence[str]) -> list[str]:
    simple = [name for name in names if split_variant(name)[0] in BASELINES]
    if not simple:
        return ["No simple baseline was run, so nothing here shows that a method is worth its effort."]
    ahead = [win for win in found if win.best > 0 and set(win.winners) <= set(simple)]
    if ahead:
        where = [
            f"{joined(list(win.winners))} in {win.column.heading} {domain_name(win.domain)} ({share(win.best)} against "
            f"{share(win.mean_of_second)} of {spaced(win.second)})"
            for win in ahead
        ]
        return [f"A simple baseline wins: {'; '.join(where)}."]
    level = [win for win in found if win.best > 0 and set(win.winners) & set(simple)]
    if level:
        where = [f"{win.column.heading} {domain_name(win.domain)}" for win in level]
        return [f"A simple baseline is as good as the best method in {joined(where)}."]
    return []


def _tally(found: Sequence[Win]) -> list[str]:
    """Say who wins how many of the comparisons, and in how many beyond noise."""
    alone = [win for win in found if len(win.winners) == 1 and win.best > 0 and win.second]
    if not alone:
        return []
    what = joined(list(dict.fromkeys(win.column.heading for win in found)))
    where = joined([domain_name(name) for name in dict.fromkeys(win.domain for win in found)])
    counts: dict[str, list[Win]] = {}
    for win in alone:
        counts.setdefault(win.winners[0], []).append(win)
    ranked = sorted(counts.items(), key=lambda item: -len(item[1]))
    parts = [f"{spaced(name)} {len(own)} ({sum(win.is_clear for win in own)} beyond noise)" for name, own in ranked]
    n_tied = len(found) - len(alone)
    tied = f"; {n_tied} won by none alone" if n_tied else ""
    return [f"Of {len(found)} comparisons ({what}; {where}), won: {', '.join(parts)}{tied}."]


def _about_silence(data: RunData, names: Sequence[str]) -> list[str]:
    """Say how often each method stays silent where nothing changed; refused pairs are counted as such."""
    worlds = [name for name in scenarios(data, unchanged=True) if is_unchanged(data, name)]
    rows = [row for row in data.results if row["scenario"] in worlds]
    parts, path_m = [], 0.0
    for name in names:
        own = [row for row in rows if row["variant"] == name]
        if not own:
            continue
        answered = [row for row in own if text(row, "status") == "ok"]
        n_silent = sum(flag(row, "is_alarm") is False for row in answered)
        refused = f" ({len(own) - len(answered)} without an answer)" if len(answered) < len(own) else ""
        parts.append(f"{spaced(name)} {n_silent} of {len(own)}{refused}")
        path_m = max(path_m, float(np.nansum([number(row, "after_path_m") for row in own])))
    where = f" ({significant(path_m / 1000.0)} km)" if path_m else ""
    return [f"Silent where nothing changed{where}: {', '.join(parts)}."] if parts else []


def _signed(value: float) -> str:
    size = share(abs(value))
    # an interval that just leaves out 0 must not read as if it touched it
    return ("+" if value >= 0 else "\u2212") + (f"{abs(value):.3f}" if value and float(size) == 0 else size)
