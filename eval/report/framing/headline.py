"""What a page says first: which plan it is about, and who leads, in one sentence."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.report.comparing.columns import COMPARED, figures_of
from eval.report.comparing.differences import NOISE, SAME, TOO_FEW, judge_methods
from eval.report.hardness import count_held, name_breaks
from eval.report.summary import HEADLINES, rank_methods
from eval.report.surface.surface import SURFACE_COLUMNS
from eval.running.results.grids import off_grids
from eval.running.results.run_data import RunData, ends_at_merge, plan_name, shown_variant, stored_table
from eval.tables.columns import Column, select, share
from eval.tables.merge_table import ALL_FAMILIES
from eval.tables.rows import ALL_DOMAINS, PAIR, is_told_the_truth, numbers, records, with_domain, with_pair

_MOST_NAMES = 3
_NEXT_SETTING = re.compile(r",(?=[a-z0-9_.-]+=)")
_FIRST_SETTING = re.compile(r"(?P<preset>[^\[]+)\[(?P<key>[^=,\]]+)=(?P<value>[^,\]]+)[,\]]")
_TOO_LITTLE = "The run holds too little to compare two methods."
_SUBJECT = "change detection between two LiDAR sessions of a tunnel"
_RIGHT = Column("right", "share of the pairs merged as their kind asks", "high", share)
_HELD = Column("held", "axes on which it holds", "high", lambda n: f"{n:.0f}")
_WITHIN, _ALARM = select(COMPARED, "is_within_target", "is_alarm")
_SILENT = Column("silent_share", "share of the unchanged pairs without a false region", "high", share)


def write_title(data: RunData) -> str:
    """Return the name of the plan and its question: the description up to its first full stop, colon or question."""
    plan = data.provenance.get("plan")
    description = " ".join(str(plan.get("description") or "").split()) if isinstance(plan, Mapping) else ""
    question, mark, _ = description.partition("? ")
    words = f"{question}?" if mark else description.partition(". ")[0].partition(": ")[0].removesuffix(".")
    name = plan_name(data)
    return f"{name}: {words or _SUBJECT}" if name else f"A run: {words or _SUBJECT}"


def write_answer(data: RunData, merges: pd.DataFrame) -> str:
    """Return who leads and who follows, by the figure that the plan is about, in each domain.

    Args:
        data: The run.
        merges: As `eval.tables.merge_table.merge_table` returns it.
    """
    if ends_at_merge(data):
        return _of_merges(data, merges)
    told = _of_axes(data) or _of_surfaces(data) or _of_pairs(data, "high") or _of_silence(data)
    return told or _of_pairs(data, "low") or _TOO_LITTLE  # nothing changed in any pair


def name_leaders(
    values: Iterable[tuple[str, float]], column: Column, judge: Callable[[str, str], str] | None = None
) -> str:
    """Return the methods with the best value as written, and those that come next; "" without two methods.

    Those that are told the truth take no part.

    Args:
        values: Name and value of each method, NaN where it is undefined.
        column: Which direction wins, and how values are written.
        judge: Gives the verdict on two methods, "" for none. The first of the best is "before" the first of the next
            only where they differ beyond noise, or where there are too few pairs to tell, which is said. Without a
            verdict the next comes "then".
    """
    fair = [(name, value) for name, value in values if not is_told_the_truth(name) and math.isfinite(value)]
    if len(fair) < 2:
        return ""
    fair.sort(key=lambda each: -each[1] if column.better == "high" else each[1])
    by_text: dict[str, list[str]] = {}
    for name, value in fair:
        by_text.setdefault(column.shown(value), []).append(name)
    (best, leaders), *others = by_text.items()
    if not others:
        return f"all {len(leaders)} methods alike ({best})"
    second, followers = others[0]
    found = judge(leaders[0], followers[0]) if judge is not None else ""
    link = {"": "then", NOISE: "not told from", SAME: "not told from"}.get(found, "before")
    told = f"{_joined(leaders)} ({best}), {link} {_joined(followers)} ({second})"
    return f"{told}, on too few pairs for a verdict" if found == TOO_FEW else told


def _joined(names: Sequence[str]) -> str:
    shown = [_shortened(name) for name in names[:_MOST_NAMES]]
    if len(set(shown)) < len(shown):  # points of a grid differ in their second setting
        shown = list(names[:_MOST_NAMES])
    if len(names) > _MOST_NAMES:
        shown.append(f"{len(names) - _MOST_NAMES} more")
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def _shortened(name: str) -> str:
    """Return a variant with the first of its settings alone."""
    first, comma, _ = name.partition(",")
    return f"{first}, \u2026]" if comma and "[" in first else name


def name_by_setting(variants: Iterable[str]) -> tuple[str, dict[str, str]]:
    """Return the first setting of some variants and its value in each, if they are one preset and the values differ.

    "" and nothing otherwise. `tunnelcd[surface.method=planes]` and `tunnelcd[surface.method=c2c,surface.reach_m=2]` are
    `surface.method`, `planes` and `c2c`.
    """
    names = list(dict.fromkeys(variants))
    found = [match for match in map(_FIRST_SETTING.match, names) if match]
    values = [match["value"] for match in found]
    is_one_setting = len({(match["preset"], match["key"]) for match in found}) == 1
    if len(found) < len(names) or not is_one_setting or len(set(values)) < len(values):
        return "", {}
    return found[0]["key"], dict(zip(names, values, strict=True))


def name_without_shared(variants: Iterable[str]) -> tuple[str, dict[str, str]]:
    """Return the settings that all of some variants share, and each variant without them; "" and nothing if none."""
    settings = {name: _NEXT_SETTING.split(name.partition("[")[2].removesuffix("]")) for name in variants}
    shared = set.intersection(*map(set, settings.values())) - {""} if len(settings) > 1 else set[str]()
    if not shared:
        return "", {}
    own = {name: ",".join(each for each in found if each not in shared) for name, found in settings.items()}
    found = {name: name.partition("[")[0] + (f"[{rest}]" if rest else "") for name, rest in own.items()}
    return ", ".join(each for each in next(iter(settings.values())) if each in shared), found


def _told(table: pd.DataFrame, column: Column, judge: Callable[[str, str, str], str] | None = None) -> str:
    """Return who leads in every domain of a table, by one of its columns.

    `judge(domain, a, b)` gives the verdict on two methods there.
    """
    names = table["variant"].astype(str)
    fair = names[~names.map(is_told_the_truth)]
    setting, values = name_by_setting(fair)
    by = f" by {setting}" if setting else ""
    if not setting:
        shared, values = name_without_shared(fair)
        by = f" with {shared}" if shared else ""
    parts = []
    for domain, own in table.assign(variant=names.replace(values)).groupby("domain", sort=False):
        if domain == ALL_DOMAINS and table["domain"].nunique() > 1:
            continue
        named = {shown: name for name, shown in values.items()}
        own_judge = partial(_judge_by_name, judge, str(domain), named) if judge is not None else None
        leaders = name_leaders(zip(own["variant"], numbers(own, column.key), strict=True), column, own_judge)
        parts += [f"{domain_name(str(domain))}: {leaders}"] if leaders else []
    extreme = "Highest" if column.better == "high" else "Lowest"
    return f"{extreme} {column.heading}{by}, {'; '.join(parts)}." if parts else ""


def _of_pairs(data: RunData, better: str) -> str:
    ranked, shown, figures = rank_methods(data)
    column = next((column for column in HEADLINES if column in shown and column.better == better), None)
    if column is None:
        return ""
    # a mean over fewer pairs, of those that suit a method, leads nothing
    is_whole = ranked["n_pairs"] == ranked.groupby("domain")["n_pairs"].transform("max")
    return _told(ranked[is_whole], column, partial(_judge_in_domain, data, figures, column))


def _judge_in_domain(data: RunData, figures: pd.DataFrame, column: Column, domain: str, first: str, second: str) -> str:
    return _judge_pairs(data, figures[figures["domain"] == domain], column, first, second)


def _judge_pairs(data: RunData, figures: pd.DataFrame, column: Column, first: str, second: str) -> str:
    """Return the verdict on two methods over the pairs of some figures (`figures_of`), "" where none can be given."""
    of_method = {name: figures[figures["variant"] == name].set_index(PAIR) for name in (first, second)}
    return judge_methods(of_method, column, first, second, data)


def _judge_by_name(
    judge: Callable[[str, str, str], str], domain: str, named: Mapping[str, str], first: str, second: str
) -> str:
    return judge(domain, named.get(first, first), named.get(second, second))


def _of_axes(data: RunData) -> str:
    points = stored_table(data, "breaking_points")
    if len(points) == 0:
        return ""
    held = count_held(points)
    if not held:
        return ""
    # methods that were measured on other axes are not compared
    measured = points[points["is_measured"]].groupby("variant")["axis"].agg(frozenset)
    is_fair = measured.nunique() == 1 and len(measured) == points["variant"].nunique()
    leaders = name_leaders(((name, float(n)) for name, n in held.items()), _HELD) if is_fair else ""
    main = shown_variant(data)
    told = name_breaks(points, main if main in held else next(iter(held)))
    return f"Holds on most axes: {leaders}; {told}." if leaders else f"{told}."


def _of_surfaces(data: RunData) -> str:
    # a limit is of the windows of all pairs together, so no difference of pairs can be taken
    table = off_grids(stored_table(data, "surface_table"), data)
    limits = [column for column in SURFACE_COLUMNS if column.heading.startswith("limit, ")]
    defined = [column for column in limits if len(table) and np.isfinite(numbers(table, column.key)).sum() > 1]
    if not defined:
        return ""
    return _told(table, replace(defined[0], heading=defined[0].heading.replace("limit,", "displacement found on")))


def _of_silence(data: RunData) -> str:
    table = off_grids(stored_table(data, "regions_table"), data)
    if len(table) == 0:
        return ""
    judge = partial(_judge_in_domain, data, figures_of(with_domain(data.results)), _ALARM)
    return _told(table[table["n_unchanged"] > 0], _SILENT, judge)


def _of_merges(data: RunData, merges: pd.DataFrame) -> str:
    rows: list[dict[str, Any]] = records(merges[merges["family"] == ALL_FAMILIES]) if len(merges) else []
    counts: dict[str, list[float]] = {}
    for row in rows:
        count = counts.setdefault(str(row["variant"]), [0.0, 0.0])
        count[0] += float(row["n_within_target"])
        count[1] += float(row["n_pairs"])
    shares = [(name, right / n if n else math.nan) for name, (right, n) in counts.items()]
    figures = figures_of(with_pair(pd.DataFrame(list(data.results))))
    leaders = name_leaders(shares, _RIGHT, partial(_judge_pairs, data, figures, _WITHIN))
    return f"Highest {_RIGHT.heading}: {leaders}." if leaders else _TOO_LITTLE
