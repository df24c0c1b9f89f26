"""Shards of a plan: every n-th pair of it, for machines that share nothing.

Pair k of the plan, from 0 and in its order, belongs to shard k mod n + 1. All cells of a pair are of one shard, so no
pair is simulated twice. The plan of a shard is the whole plan; only the cells differ.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cdpipe.core.errors import InputError
from eval.plans.variants import Cell


@dataclass(frozen=True, slots=True)
class Shard:
    """Shard `index` of `n`, from 1."""

    index: int
    n: int

    def __str__(self) -> str:
        return f"{self.index}/{self.n}"


def parse_shard(text: str) -> Shard:
    """Return the shard that "2/5" names.

    Raises:
        InputError: It has another form, or there is no such shard.
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip(), re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise InputError(f"--shard {text}: expected i/n with i from 1 to n, for example 2/5")
    return Shard(int(match[1]), int(match[2]))


def stored_shard(provenance: Mapping[str, Any]) -> Shard | None:
    """Return the shard that a run is of; None for a whole run.

    Raises:
        InputError: Provenance names a shard that cannot be.
    """
    told = provenance.get("shard")
    return None if told is None else parse_shard(str(told))


def number_pairs(cases: Iterable[tuple[str, int]]) -> dict[tuple[str, int], int]:
    """Return the place of every pair (world, seed) in the plan's order, from 0."""
    return {pair: place for place, pair in enumerate(dict.fromkeys(cases))}


def choose_cells(cells: Sequence[Cell], shard: Shard | None) -> list[Cell]:
    """Return the cells of a shard in the plan's order; all cells without a shard.

    Raises:
        InputError: The plan has fewer pairs than there are shards.
    """
    if shard is None:
        return list(cells)
    places = number_pairs((cell.scenario, cell.seed) for cell in cells)
    if len(places) < shard.n:
        pairs = "1 pair" if len(places) == 1 else f"{len(places)} pairs"
        raise InputError(f"--shard {shard}: the plan has {pairs}, which stay whole: make at most {len(places)} shards")
    return [cell for cell in cells if places[cell.scenario, cell.seed] % shard.n == shard.index - 1]


def require_same_shard(place: str, provenance: Mapping[str, Any], shard: Shard | None) -> None:
    """Refuse to run a shard in the folder of another one, or of a whole run. A whole run may complete a shard.

    Raises:
        InputError: The folder belongs to something else.
    """
    if shard is None or not provenance:
        return
    found = stored_shard(provenance)
    if found != shard:
        what = "a run of the whole plan" if found is None else f"shard {found}"
        raise InputError(f"{place}: holds {what}, this is shard {shard}: name a folder of its own for each shard")
