"""What the methods and the columns of a page are: shown beside each name, and in two sections of the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cdpipe.core.yamlfile import read_head_comment
from cdpipe.model.config import preset_files
from eval.running.results.grids import split_variant
from eval.tables.columns import Column, spaced
from eval.tables.rows import is_told_the_truth

_ORACLES = {
    "oracle-merge": "takes the merge from the truth",
    "oracle-regions": "takes the regions from the truth",
}
_MOST_CHARACTERS = 400


@dataclass(frozen=True, slots=True)
class Entry:
    """One name of the glossary.

    Attributes:
        id: Its place in the page.
        name: The method or the heading.
        meanings: What it is, and what is to be known besides, "" for nothing; a heading of several tables has several.
        is_oracle: Whether it is a method that is told the truth.
    """

    id: str
    name: str
    meanings: tuple[tuple[str, str], ...]
    is_oracle: bool = False


def describe_methods(variants: Iterable[str]) -> list[Entry]:
    """Return an entry for each method, in their order; settings over a method belong to its entry."""
    names = dict.fromkeys(split_variant(variant)[0] for variant in variants)
    return [
        Entry(f"m{place}", name, ((_describe_method(name), ""),), is_told_the_truth(name))
        for place, name in enumerate(names, 1)
    ]


def describe_columns(columns: Iterable[Column], more: Iterable[tuple[str, str, str]] = ()) -> list[Entry]:
    """Return an entry for each heading; columns of one heading share it, each with its meaning.

    Args:
        columns: The columns of the page.
        more: Further names with what they are and what is to be known besides.
    """
    found: dict[str, dict[tuple[str, str], None]] = {}
    told = [*((column.heading, column.meaning, column.when_undefined) for column in columns), *more]
    for heading, meaning, besides in told:
        found.setdefault(heading, {})[meaning, besides] = None
    return [Entry(f"c{place}", name, tuple(own)) for place, (name, own) in enumerate(found.items(), 1)]


def index_entries(methods: Sequence[Entry], columns: Sequence[Entry], variants: Iterable[str]) -> dict[str, Entry]:
    """Return the entry of every text that a page shows: of a variant by its name, of a heading after "column "."""
    of_method = {entry.name: entry for entry in methods}
    found = {f"column {entry.name}": entry for entry in columns}
    for variant in variants:
        entry = of_method[split_variant(variant)[0]]
        found[variant] = found[spaced(variant)] = entry
    return found


def _describe_method(name: str) -> str:
    if is_told_the_truth(name):
        parts = [_ORACLES.get(part, part) for part in name.split("+")]
        return f"An upper bound: {' and '.join(parts)}; everything else as tunnelcd."
    file = preset_files().get(name)
    text = read_head_comment(file) if file is not None else ""
    return _shorten(text) if text else "No preset of this tunnelcd: a method of whoever made the run."


def _shorten(text: str) -> str:
    """Return as many whole sentences as there is room for, one at least."""
    first, *more = text.split(". ")
    for sentence in more:
        if len(first) + len(sentence) > _MOST_CHARACTERS:
            return f"{first}."
        first += f". {sentence}"
    return first
