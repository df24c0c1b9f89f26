"""The content of a cell's file: its key, its place among the rows, its row and its items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_json
from eval.core.provenance import FORMAT_VERSION
from eval.running.cell_rows import IDENTITY, ITEM_TABLES, SURFACE_TABLES
from eval.running.runfolder import json_text
from eval.scoring.scoring import CaseScore

# key and position of a cell of another program: its rows come last
NO_KEY, LAST = "", (1_000_000, 1_000_000)


def cell_document(score: CaseScore, identity: Mapping[str, Any], key: str, place: Sequence[int]) -> dict[str, Any]:
    """Return the content of a cell; each item carries the columns that identify its row of results.csv.

    Args:
        score: Its scores.
        identity: scenario, seed, variant, preset, pair_kind and commit; they replace the answer's own names.
        key: Digest of everything that the cell depends on.
        place: Position of its rows in the tables: scenario, variant.

    Raises:
        InputError: It is larger than what is read again.
    """
    names = {name: identity[name] for name in IDENTITY}
    items = {table: [{**names, **item} for item in getattr(score, table)] for table in ITEM_TABLES}
    items |= {
        table: [{**names, **item} for item in rows] for table in SURFACE_TABLES if (rows := getattr(score, table))
    }
    head = {"format_version": FORMAT_VERSION, "key": key, "order": list(place)}
    document = {**head, "row": {**score.row, **identity}, **items}
    try:
        parse_json(json_text(document))
    except ValueError as error:
        told = ", ".join(f"{len(rows)} {table}" for table, rows in items.items() if rows)
        case = "{scenario} {seed} {variant}".format(**identity)
        raise InputError(f"{case}: its scores are {error} ({told}): answer with fewer regions or objects") from error
    return document
