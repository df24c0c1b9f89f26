"""The leaderboard: one offline page with the packed results of many methods beside the reference rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.names import bare, visible
from eval.core.output import made_parents, require_replaceable
from eval.core.terminal.printing import count_pairs
from eval.leaderboard.calls import list_merges
from eval.leaderboard.comparison import (
    FIGURES,
    HEADINGS,
    SHOWN,
    list_variants,
    note_other_worlds,
    part_pairs,
    show_figure,
    show_span,
    summarise_figures,
    take_figures,
)
from eval.leaderboard.reference import find_reference
from eval.leaderboard.submission import CheckedFile
from eval.plans.files import plan_names
from eval.plans.plan import load_plan
from eval.plans.splits import find_split
from eval.report.render import render_page, write_file
from eval.running.results.run_data import RunData
from eval.tables.rows import PAIR, with_pair

_HEAD = b"<title>tunnelcd: leaderboard</title>"
_F1 = replace(
    SHOWN["object_f1_50"],
    meaning=SHOWN["object_f1_50"].meaning + " Of a pair in which nothing changed: 1 if the answer has no region and no "
    "object, 0 if it has one or there is none.",
    when_undefined="",
)
_MERGES = {"own": "its own", "given": "told the true one", "ours": "told tunnelcd's"}


@dataclass(frozen=True, slots=True)
class Shown:
    """A cell of the page: its text and its interval."""

    text: str
    interval: str = ""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a table."""

    cells: tuple[Shown, ...]
    is_reference: bool


@dataclass(frozen=True, slots=True)
class Board:
    """One table: submissions about the same pairs of one plan, and the reference rows of these pairs."""

    title: str
    lines: tuple[Line, ...]
    notes: tuple[str, ...]


def require_page(out: Path) -> None:
    """Refuse what is no name of a page, or holds something else.

    Raises:
        InputError: It does.
    """
    if out.suffix != ".html" or out.is_dir():
        raise InputError(f"--out {out}: expected the name of a file that ends in .html")
    require_replaceable(out, _HEAD, "page of `tunnelcd leaderboard`")


def write_leaderboard(files: Sequence[CheckedFile], out: Path, reference: Path | None) -> None:
    """Write the page.

    Args:
        files: The submissions.
        out: The .html file.
        reference: Where reference results are, as in `find_reference`.

    Raises:
        InputError: Two submissions are of one method on the same pairs, or a file cannot be read or written.
    """
    require_page(out)
    boards: list[Board] = []
    for group in _group(files):
        data = find_reference(group[0].content.plan, reference)
        _refuse_unmade(group, files, data)
        boards += _make_boards(group, data)
    told = [
        {"name": each.content.name, "file": each.path.name, "sha256": each.sha256, "content": each.content,
         "command": " ".join(each.content.command), "n_checked": each.n_checked,
         "version": each.content.versions.get("tunnelcd", "")}
        for each in files
    ]  # fmt: skip
    columns = [(heading, _F1 if key == _F1.key else SHOWN[key]) for key, heading in HEADINGS.items()]
    headings = ("method", "merge", "pairs", *HEADINGS.values())
    content = {"boards": boards, "headings": headings, "files": told, "columns": columns}
    with made_parents(out):
        write_file(out, render_page("leaderboard.html", content))


def _group(files: Sequence[CheckedFile]) -> list[list[CheckedFile]]:
    """Return the submissions of the same plan and pairs together; refuse two among them whose names look alike."""
    groups: dict[tuple[Any, ...], list[CheckedFile]] = {}
    for each in files:
        pairs = frozenset((pair.scenario, pair.seed) for pair in each.content.pairs)
        groups.setdefault((each.content.plan, pairs), []).append(each)
    for group in groups.values():
        names = [bare(each.content.name) for each in group]
        first = next((name for name in names if names.count(name) > 1), None)
        if twice := [each for each, name in zip(group, names, strict=True) if name == first]:
            told = " and ".join(str(each.path) for each in twice[:2])
            shown = " and ".join(dict.fromkeys(visible(each.content.name) for each in twice[:2]))
            alike = ", which look alike," if " and " in shown else ""
            raise InputError(f"{told}: two results of {shown}{alike} on the same pairs: leave one out")
    return list(groups.values())


def _refuse_unmade(group: Sequence[CheckedFile], files: Sequence[CheckedFile], data: RunData | None) -> None:
    """Refuse a pair without an answer, as one that cannot be made, that another file or the reference answers."""
    rows = () if data is None else with_pair(pd.DataFrame(list(data.results)))[PAIR].itertuples(index=False, name=None)
    made = dict.fromkeys(rows, "" if data is None else data.folder.path.name)
    for each in files:
        if each.content.plan == group[0].content.plan:
            made |= {(pair.scenario, pair.seed): each.path.name for pair in each.content.pairs if pair.pair_digest}
    for each in group:
        for pair in each.content.pairs:
            if not pair.files and (other := made.get((pair.scenario, pair.seed))):
                raise InputError(
                    f"{each.path}: {visible(pair.scenario)} {pair.seed}: no answer, as a pair that cannot be made; "
                    f"{other} has it: leave the file out, or evaluate and submit again"
                )


def _make_boards(group: Sequence[CheckedFile], data: RunData | None) -> Iterator[Board]:
    """Yield a table for each kind of pairs (`part_pairs`); the notes stand below the last."""
    first = group[0].content
    own = {each.content.name: count_silence(take_figures(take_rows(each))) for each in group}
    merges = {} if data is None else {name: _MERGES[merge] for name, merge in list_merges(data.folder).items()}
    parts = part_pairs(own[first.name])
    for part, pairs in parts.items():
        rows = [(summarise_figures(name, found.loc[pairs]), _MERGES[each.content.merge], False)
                for (name, found), each in zip(own.items(), group, strict=True)]  # fmt: skip
        # a run in which a method was evaluated holds its rows, too
        variants = list_variants([] if data is None else [data], pairs)
        references = [(name, count_silence(found)) for name, found in variants if name not in own]
        rows += [(summarise_figures(name, found), merges.get(name, ""), True) for name, found in references]
        rows.sort(key=lambda row: _place(row[0]))
        told = [
            f"Plan {first.plan}",
            *([part] if part else []),
            count_pairs(len(pairs)),
            *_tell_split(group),
        ]
        notes = _notes(group, data, len(pairs), rows) if part == [*parts][-1] else ()
        yield Board(", ".join(told), tuple(_line(*row) for row in rows), tuple(notes))


def count_silence(figures: pd.DataFrame) -> pd.DataFrame:
    """Let each pair in which nothing changed count in F1: 1 where the answer is silent, 0 where it counts as an alarm.

    F1 is undefined there: without it, who calls something a change on every pair has the place of who does not. A
    refusal that may be right is neither.
    """
    silence = 1.0 - figures["is_alarm"]
    return figures.assign(object_f1_50=figures["object_f1_50"].where(silence.isna(), silence))


def _tell_split(group: Sequence[CheckedFile]) -> Iterator[str]:
    """Yield the split that the seeds are of; nothing for the split for development, which plans name."""
    seeds = [pair.seed for pair in group[0].content.pairs]
    split = find_split(seeds, [each.content.split for each in group])
    if split != "dev":
        first, last = min(seeds), max(seeds)
        yield split or f"{f'seed {first}' if first == last else f'seeds {first} to {last}'} of no test split"


def take_rows(each: CheckedFile) -> pd.DataFrame:
    """Return the rows of a submission, with the kinds of pairs that a shipped plan says: a kind may allow to refuse."""
    name = each.content.plan
    kinds = {world.label: world.pair_kind for world in load_plan(name).worlds} if name in plan_names() else {}
    return pd.DataFrame([{**pair.row, "pair_kind": kinds.get(pair.scenario, "")} for pair in each.content.pairs])


def _line(row: dict[str, Any], merge: str, is_reference: bool) -> Line:
    answered = Shown(f"{row['n_answered']}/{row['n_pairs']}")
    figures = [
        Shown(show_figure(key, row[key]), show_span(key, row[f"{key}_low"], row[f"{key}_high"])) for key in FIGURES
    ]
    # what a reference was given stands in its run; nothing tells what a program of others had
    told = Shown(merge, "" if is_reference else "the sender's word")
    return Line((Shown(row["method"]), told, answered, *figures), is_reference)


def _notes(
    group: Sequence[CheckedFile], data: RunData | None, n_pairs: int, rows: Sequence[tuple[dict[str, Any], str, bool]]
) -> Iterator[str]:
    references = [row for row, _, is_reference in rows if is_reference]
    if not references:
        where = "none is at hand" if data is None else f"{data.folder.path.name} holds none of these pairs"
        yield f"No reference rows: {where}."
    elif any(row["n_pairs"] < n_pairs for row in references):
        yield "A reference row with fewer pairs is a mean over those alone."
    if n_unmade := sum(not pair.files for pair in group[0].content.pairs):
        verb = "is" if n_unmade == 1 else "are"
        yield f"{count_pairs(n_unmade)} could not be made, as the file says, and {verb} in no mean."
    yield from note_other_worlds(pd.concat(map(take_rows, group)), [] if data is None else [data])
    digests: dict[tuple[str, int], str] = {}
    for each in group:
        differing = [
            pair for pair in each.content.pairs
            if digests.setdefault((pair.scenario, pair.seed), pair.pair_digest) != pair.pair_digest
        ]  # fmt: skip
        if differing:
            other = group[0].content.name
            yield f"{each.content.name} answered other simulations of {count_pairs(len(differing))} than {other}."


def _place(row: Mapping[str, Any]) -> tuple[float, ...]:
    """Return what sorts the best first: F1 (`count_silence`), which false objects and alarms lower, then the others."""
    high = (row["object_f1_50"], row["object_iou_point"], row["region_recall"])
    order = (*(-value for value in high), row["is_alarm"], row["false_regions_per_100m"])
    return tuple(math.inf if math.isnan(value) else value for value in order)
