"""Scores stored answers: for the runner, and for `tunnelcd score`, which runs no method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_json
from cdpipe.core.names import require_table_name, visible
from eval.core.progress import RunProgress, Silent
from eval.core.provenance import FORMAT_VERSION
from eval.running.runfolder import (
    IDENTITY,
    ITEM_TABLES,
    SURFACE_TABLES,
    RunFolder,
    json_text,
    write_json,
    write_tables,
)
from eval.scoring.scoring import CaseScore, score_stored
from eval.truth.ground_truth import load_ground_truth

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


def rescore(run: RunFolder, progress: RunProgress | None = None) -> int:
    """Score every stored answer of a run again and rewrite the tables.

    An answer of another program becomes a variant named like its folder. Nothing is written before all answers are
    scored, so a damaged answer or an interrupt leaves the run as it was.

    Returns:
        How many answers were scored.

    Raises:
        InputError: An answer is damaged, its pair has no truth, or a table would read its name as something else.
    """
    progress = progress or Silent()
    folders = sorted(file.parent for file in run.path.glob("answers/*/*/*/answer.json"))
    documents: dict[Path, dict[str, Any]] = {}
    place: Sequence[int]
    for (slug, seed), group in groupby(folders, key=lambda folder: folder.parts[-3:-1]):
        truth = load_ground_truth(run.path / "pairs" / slug / seed)
        for folder in group:
            path = run.path / "cells" / slug / seed / f"{folder.name}.json"
            stored = run.read_cell(path)
            if stored is None:
                _require_readable_name(folder)
                identity = foreign_identity(run, slug, seed, folder.name)
                key, place = NO_KEY, LAST
            else:
                row = {"pair_kind": "", "is_contended": False, **stored["row"]}  # older cells lack these two
                names = (*IDENTITY, "preset", "commit", "pair_kind", "is_contended")
                identity = {name: row.get(name) for name in names}
                key, place = stored["key"], stored["order"]
            progress.cells("{scenario} {seed} {variant}".format(**identity), len(documents), len(folders))
            score = score_stored(truth, folder, may_end_early=key != NO_KEY)
            documents[path] = cell_document(score, identity, key, place)
    for path, document in documents.items():
        write_json(path, document)
    progress.cells("done", len(documents), len(documents))
    write_tables(run)
    return len(documents)


def foreign_identity(run: RunFolder, slug: str, seed: str, name: str) -> dict[str, Any]:
    """Return the identity of an answer of another program, for `cell_document`.

    The world gets the name that the run's own cells give it, or that of its folder where there are none.
    """
    row = run.any_row(slug) or {"scenario": slug.replace("__", "/")}
    world = {"scenario": row["scenario"], "pair_kind": row.get("pair_kind", "")}
    who = {"seed": int(seed), "variant": name, "preset": name, "commit": None, "is_contended": False}
    return {**world, **who}


def _require_readable_name(answer: Path) -> None:
    try:
        require_table_name(answer.name)
    except ValueError as error:
        raise InputError(f"{answer.parent}: the answer {visible(answer.name)}: {error}") from error
