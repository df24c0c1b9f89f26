"""The first paragraph of the page, made from the numbers: who wins where and by how much, rivals first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from eval.report.tables import alarm_text
from eval.running.run_data import (
    BASELINES,
    Row,
    RunData,
    defined,
    grids,
    named_variants,
    number,
    of,
    over_pairs,
    repeats,
    scenarios,
    split_variant,
    text,
)
from eval.tables.columns import RESULT_COLUMNS, share

HEADLINE_COLUMNS = tuple(
    (column, name)
    for column in RESULT_COLUMNS
    for key, name in (("region_recall", "region recall"), ("object_iou_point", "object IoU"))
    if column.key == key
)

WRONG_MERGE_M = 1.0
_MAX_NAMED = 8


@dataclass(frozen=True, slots=True)
class Ranking:
    """Who is best at one figure on one scenario, judged as written.

    Attributes:
        scenario: Where.
        measure: Name of the figure.
        winners: The variants that share the best value; none where no variant has one above 0.
        best: That value.
        runner_up: The best of the others, or "".
        second: Its value.
    """

    scenario: str
    measure: str
    winners: tuple[str, ...]
    best: float
    runner_up: str
    second: float


def story(data: RunData) -> list[str]:
    """Return the sentences of the first paragraph."""
    answered = [
        name
        for name in scenarios(data, unchanged=False)
        if any(row["status"] == "ok" for row in of(data.results, scenario=name))
    ]
    rankings = [
        rank(scenario, measure, scenario_means(data, scenario, column.key))
        for scenario in answered
        for column, measure in HEADLINE_COLUMNS
    ]
    unanswered = [name for name in scenarios(data, unchanged=False) if name not in answered]
    shown = list(dict.fromkeys(name for scenario in answered for name in named_variants(data, scenario)))
    if len(shown) < 2 and (tried := about_grids(data)):
        return [*tried, *about_wrong_merges(data), *about_failures(data), about_size(data), *about_repeated(data)]
    return [
        _about_baselines(rankings, shown),
        *about_grids(data),
        *about_wrong_merges(data),
        *(sentence(ranking) + _price(data, ranking) for ranking in rankings),
        *(f"On {name}, no preset gave an answer." for name in unanswered),
        *about_failures(data),
        *_about_unchanged(data),
        about_size(data),
        *about_repeated(data),
    ]


def about_grids(data: RunData) -> list[str]:
    """Say which methods' settings were tried on grids, if any: their points are not among the results."""
    n_points: dict[str, set[str]] = {}
    for grid in grids(data):
        n_points.setdefault(grid.preset.partition(" with ")[0], set()).update(grid.points.values())
    if not n_points:
        return []
    named = [f"{preset} ({len(points)} variants)" for preset, points in n_points.items()]
    return [f"Settings were tried on grids, shown below and not compared here: {joined(named)}."]


def scenario_means(data: RunData, scenario: str, column: str) -> dict[str, float]:
    """Return the mean of a column for every named variant of a scenario."""
    return {
        name: over_pairs(of(data.results, scenario=scenario, variant=name), column)
        for name in named_variants(data, scenario)
    }


def rank(scenario: str, measure: str, means: Mapping[str, float]) -> Ranking:
    """Order variants by a figure as it is written (two decimals); undefined ones take no part."""
    written = {name: round(value, 2) for name, value in means.items() if not math.isnan(value)}
    top = max(written.values(), default=math.nan)
    winners = tuple(name for name, value in written.items() if value == top and value > 0)
    others = {name: value for name, value in written.items() if name not in winners}
    runner_up = max(others, key=lambda name: others[name]) if others else ""
    return Ranking(scenario, measure, winners, top, runner_up, others.get(runner_up, math.nan))


def sentence(ranking: Ranking) -> str:
    """Say in words who is best."""
    where = f"On {ranking.scenario}, {ranking.measure}:"
    if math.isnan(ranking.best):
        return f"{where} undefined for every preset."
    if not ranking.winners:
        return f"{where} no preset gets above 0."
    verb = "is best with" if len(ranking.winners) == 1 else "tie at"
    margin = ""
    if ranking.runner_up:
        margin = f", {share(ranking.best - ranking.second)} ahead of {ranking.runner_up} ({share(ranking.second)})"
    return f"{where} {joined(ranking.winners)} {verb} {share(ranking.best)}{margin}."


def joined(names: Sequence[str]) -> str:
    """Return "a", "a and b" or "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _price(data: RunData, ranking: Ranking) -> str:
    """Say how many false regions the winners of a recall report: recall alone rewards reporting everything."""
    if ranking.measure != "region recall" or not ranking.winners:
        return ""
    rates = scenario_means(data, ranking.scenario, "false_regions_per_100m")
    return f" False regions per 100 m: {', '.join(f'{name} {share(rates[name])}' for name in ranking.winners)}."


def _about_baselines(rankings: Sequence[Ranking], variants: Sequence[str]) -> str:
    run_baselines = [name for name in variants if _is_baseline(name)]
    if not run_baselines:
        return "No simple baseline was run, so nothing here shows that the method is worth its effort."
    if len(run_baselines) == len(variants):
        return f"Only simple baselines were run: {joined(run_baselines)}."
    ahead, level = [], []
    for ranking in rankings:
        simple = [name for name in ranking.winners if _is_baseline(name)]
        what = f"{ranking.measure} on {ranking.scenario}"
        if simple and len(simple) == len(ranking.winners):
            ahead.append(f"{joined(simple)} in {what} ({share(ranking.best)})")
        elif simple:
            level.append(f"{joined(simple)} in {what} ({share(ranking.best)})")
    parts = []
    if ahead:
        parts.append(f"A simple baseline beats every form of the pipeline: {'; '.join(ahead)}.")
    if level:
        parts.append(f"A simple baseline is as good as the best form of the pipeline: {'; '.join(level)}.")
    if not parts:
        names = joined(run_baselines)
        return f"The simple baselines that were run ({names}) win neither region recall nor object IoU anywhere."
    return " ".join(parts)


def _is_baseline(variant: str) -> bool:
    return split_variant(variant)[0] in BASELINES


def about_wrong_merges(data: RunData) -> list[str]:
    """Name the scenarios on which an accepted merge is so wrong that the scores after it say little about a method."""
    found = []
    for scenario in dict.fromkeys(str(row["scenario"]) for row in data.results):
        errors = defined(of(data.results, scenario=scenario), "merge_error_m")
        if (errors > WRONG_MERGE_M).any():
            n = int((errors > WRONG_MERGE_M).sum())
            found.append(
                f"On {scenario}, {n} of {len(errors)} cases rest on a merge that was accepted and is wrong by up to "
                f"{errors.max():.1f} m: what follows the merge cannot be judged by them."
            )
    return found


def is_unmade(row: Row) -> bool:
    """Tell whether a case has no truth: its world could not be made, or its worker died over it."""
    return text(row, "status") != "ok" and "n_observable" in row and math.isnan(number(row, "n_observable"))


def about_failures(data: RunData) -> list[str]:
    """Say how many cases gave no answer, and how many of them have no truth to be held against."""
    bad = [row for row in data.results if text(row, "status") != "ok"]
    n_unmade = sum(is_unmade(row) for row in bad)
    n_all, n_refused = len(data.results), len(bad) - n_unmade
    found = []
    if n_refused:
        words = f"{n_refused} of {n_all} cases gave no answer (refused merge or error)"
        found.append(f"{words}; they count as found nothing and are listed below.")
    if n_unmade:
        found.append(
            f"{n_unmade} of {n_all} cases could not be judged, as their world could not be made or their worker died; "
            "they count among the failed and are left out of every mean."
        )
    return found


def _about_unchanged(data: RunData) -> list[str]:
    found = []
    for scenario in scenarios(data, unchanged=True):
        verdicts = {
            name: alarm_text(of(data.results, scenario=scenario, variant=name))
            for name in named_variants(data, scenario)
        }
        alarmed = [name for name, verdict in verdicts.items() if "alarm" in verdict]
        refused = [name for name, verdict in verdicts.items() if "refused" in verdict]
        words = f"{len(alarmed)} of {len(verdicts)} presets raise a false alarm"
        words += f" ({joined(alarmed)})" if alarmed else ""
        words += f"; {joined(refused)} refused the merge or failed" if refused else ""
        found.append(f"Where nothing changed ({scenario}), {words}.")
    return found


def about_size(data: RunData) -> str:
    """Say how many pairs stand behind the figures."""
    held = repeats(data)
    pairs: dict[str, set[int]] = {}
    for row in data.results:
        if (row["scenario"], row["variant"]) not in held:
            pairs.setdefault(str(row["scenario"]), set()).add(int(row["seed"]))
    seeds = sorted(set().union(*pairs.values()))
    named = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    n = sum(len(found) for found in pairs.values())
    if all(len(found) == 1 for found in pairs.values()):
        return (
            f"n = {n} session pair{'s' if n > 1 else ''}, one per scenario ({named}): a single pair carries no "
            "interval, and a difference between two presets on it may be chance."
        )
    counts = {len(found) for found in pairs.values()}
    if len(pairs) > _MAX_NAMED and len(counts) == 1:
        return (
            f"n = {n} session pairs ({len(pairs)} scenarios with {counts.pop()} each; {named}); values are means over "
            "the pairs where they are defined."
        )
    sizes = ", ".join(f"{name}: {len(found)}" for name, found in pairs.items())
    return f"n = {n} session pairs ({sizes}; {named}); values are means over the pairs where they are defined."


def about_repeated(data: RunData) -> list[str]:
    """Say which worlds are repeated with something set otherwise."""
    held = repeats(data)
    if not held:
        return []
    n = len({world for world, _ in held})
    what = "1 further world repeats" if n == 1 else f"{n} further worlds repeat"
    names = joined(list(dict.fromkeys(held.values())))
    return [f"{what} {names} with something set otherwise; what that does stands under its own heading."]
