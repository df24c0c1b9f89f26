"""Scores stored answers: for the runner, and for `tunnelcd score`, which runs no method."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.names import require_table_name, visible
from eval.core.terminal.progress import RunProgress, Silent
from eval.running.cell_file import LAST, NO_KEY, cell_document
from eval.running.cell_rows import IDENTITY, is_row_of_unmade
from eval.running.runfolder import RunFolder, write_json, write_tables
from eval.running.scaling.keeping import list_dropped
from eval.running.scaling.remaking import remade_below
from eval.scoring.scoring import METRICS_VERSION, score_stored
from eval.truth.ground_truth import load_ground_truth


def rescore(run: RunFolder, progress: RunProgress | None = None) -> int:
    """Score every stored answer of a run again and rewrite the tables.

    An answer of another program becomes a variant named like its folder. Nothing is written before all answers are
    scored, so a damaged answer or an interrupt until then leaves the run as it was. Tables are of before or of after.

    Returns:
        How many answers were scored.

    Raises:
        InputError: An answer is damaged, its pair has no truth, or a table would read its name as something else.
    """
    progress = progress or Silent()
    folders = sorted(file.parent for file in run.path.glob("answers/*/*/*/answer.json"))
    if not folders and list_dropped(run):
        raise InputError(f"{run.path}: `run --keep nothing` left rows alone: run the plan again with --force")
    documents: dict[Path, dict[str, Any]] = {}
    place: Sequence[int]
    for (slug, seed), group in groupby(folders, key=lambda folder: folder.parts[-3:-1]):
        # sessions that were removed are made again, one pair at a time
        pair = run.path / "pairs" / slug / seed
        with remade_below([pair], progress):
            truth = load_ground_truth(pair)
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
    n_scored, left = len(documents), _list_unscored(run, documents)
    for path, document in documents.items():
        write_json(path, document)
    progress.cells("done", n_scored, n_scored)
    if left:
        told = f"{len(left)} cells of another metrics version have no answer here, as {left[0]}"
        progress.note(f"{run.path}: {told}: `run` the plan again with --force, which makes them anew")
    write_tables(run)
    return n_scored


def _list_unscored(run: RunFolder, documents: dict[Path, dict[str, Any]]) -> list[str]:
    """Return the cells of another metrics version without an answer; of those without a truth the version is raised."""
    left = []
    for path in sorted((run.path / "cells").glob("*/*/*.json")):
        stored = None if path in documents else run.read_cell(path)
        if stored is None or stored["row"].get("metrics_version") == METRICS_VERSION:
            continue
        if is_row_of_unmade(stored["row"]):  # a row of no figures
            documents[path] = {**stored, "row": {**stored["row"], "metrics_version": METRICS_VERSION}}
        else:
            left.append(str(path.relative_to(run.path / "cells").with_suffix("")))
    return left


def foreign_identity(run: RunFolder, slug: str, seed: str, name: str) -> dict[str, Any]:
    """Return the identity of an answer of another program, for `cell_document`.

    The world gets the name that the run's own cells give it, or that of its folder where there are none.

    Raises:
        InputError: The name of the pair's folder is no seed.
    """
    if not re.fullmatch(r"\d{1,15}", seed, re.ASCII):
        told = visible(f"{slug}/{seed}")
        raise InputError(f"{run.path}: holds {told}, whose name is no seed: move it out of the run")
    row = run.any_row(slug) or {"scenario": slug.replace("__", "/")}
    world = {"scenario": row["scenario"], "pair_kind": row.get("pair_kind", "")}
    who = {"seed": int(seed), "variant": name, "preset": name, "commit": None, "is_contended": False}
    return {**world, **who}


def _require_readable_name(answer: Path) -> None:
    try:
        require_table_name(answer.name)
    except ValueError as error:
        raise InputError(f"{answer.parent}: the answer {visible(answer.name)}: {error}") from error
