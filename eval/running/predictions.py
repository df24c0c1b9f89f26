"""Adds the predictions of another program to a run, as a variant.

    DIR/<scenario>/<seed>/answer.json, answer.npz     in the format of eval/scoring/ANSWERS.md
    DIR/<opaque name>/answer.json, answer.npz         the same, of a pair that `tunnelcd export` handed out blind

Every pair of the run needs a prediction; otherwise its means would be over other pairs than those of the other
variants. A pair that the program could not do gets an answer.json of status `failed` and scores like our failures.
"""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.names import bare, folded, path_part, require_table_name, visible
from cdpipe.core.whole_file import whole_file
from cdpipe.core.yamlfile import suggest
from cdpipe.io.answer import ANSWER_FILES, require_answer_sizes
from cdpipe.model.config import preset_names
from eval.core.output import remove
from eval.core.tablefile import read_table
from eval.core.terminal.progress import RunProgress, Silent
from eval.plans.cells import list_planned_cases
from eval.plans.coverage import read_stored_plan
from eval.running.cell_file import LAST, NO_KEY, cell_document
from eval.running.export import copy_pair, list_pairs, list_pairs_blindly, name_blindly
from eval.running.rescoring import foreign_identity
from eval.running.results.sides import list_versions
from eval.running.runfolder import RunFolder, open_run_folder, write_json, write_tables
from eval.scoring.scoring import METRICS_VERSION, score_stored
from eval.truth.ground_truth import load_ground_truth

_TOLD = 5


def add_predictions(run: RunFolder, folder: Path, name: str, progress: RunProgress | None = None) -> int:
    """Score the predictions of a folder, copy them into a run as the variant `name`, and rewrite the tables.

    Nothing is written before all of them are scored.

    Returns:
        How many were scored.

    Raises:
        InputError: A case is missing or of no pair of this run, a file cannot be an answer to its pair (all such files
            at once), the name is taken, or the run was scored by other metrics.
    """
    progress = progress or Silent()
    found = _matched(run, folder, list_pairs(run))
    require_free_name(run, name)
    _require_not_evaluated(run, name)
    require_current_scores(run)
    documents: dict[Path, dict[str, Any]] = {}
    mistakes: list[str] = []
    for pair, prediction in found.items():
        identity = foreign_identity(run, pair.parent.name, pair.name, name)
        progress.cells("{scenario} {seed} {variant}".format(**identity), len(documents), len(found))
        mistakes += _find_unscored(run, identity, prediction)
        try:
            score = score_stored(load_ground_truth(pair), prediction)
            documents[pair] = cell_document(score, identity, NO_KEY, LAST)
        except InputError as error:
            mistakes += str(error).split("\n")
    if mistakes:
        raise InputError("\n".join(mistakes))
    for pair, document in documents.items():
        scenario, seed = document["row"]["scenario"], int(pair.name)
        answer = run.answer(scenario, seed, name)
        remove(answer)
        for file in reversed(ANSWER_FILES):  # answer.json last: after an interrupt the same call begins anew
            if (found[pair] / file).is_file():
                with whole_file(answer / file) as partial:
                    shutil.copyfile(found[pair] / file, partial)
        write_json(run.cell(scenario, seed, name), document)
    progress.cells("done", len(documents), len(documents))
    write_tables(run)
    return len(documents)


def evaluate(predict: Callable[[Path, Path], object], run: Path | str, name: str) -> pd.DataFrame:
    """Let a function answer every pair of a run, blind, and score its answers as the variant `name`.

    Args:
        predict: Called with a folder that holds the sessions `before` and `after` of one pair without their truth, and
            with the folder that it writes `answer.json` and `answer.npz` to. The order of the pairs tells nothing; it
            is that of the opaque names in RUN/blind.json, or drawn anew where there is none.
        run: Folder of a run whose pairs are kept.
        name: Its variant in the tables.

    Returns:
        Its rows of results.csv.

    Raises:
        InputError: As `add_predictions`, or a session is damaged. What `predict` raises is passed on; nothing is
            written to the run then.
    """
    folder = open_run_folder(Path(run))
    require_free_name(folder, name)
    _require_not_evaluated(folder, name)
    require_current_scores(folder)
    with TemporaryDirectory(prefix="tunnelcd-") as place:
        pair, answer, kept, answers = (Path(place) / part for part in ("pair", "answer", "kept", "answers"))
        kept.mkdir()
        originals = list_pairs_blindly(folder)
        for number, original in enumerate(originals):
            pair.mkdir()
            answer.mkdir()
            copy_pair(original, pair)
            predict(pair, answer)
            if not (answer / ANSWER_FILES[0]).is_file():
                raise InputError(
                    f"pair {number + 1} of {len(originals)}: the function wrote no {ANSWER_FILES[0]} to its second "
                    'argument: write one of status "failed" where there is no answer'
                )
            try:
                require_answer_sizes(answer)
            except InputError as error:
                told = str(error).replace(f"{answer}/", "")
                raise InputError(f"pair {number + 1} of {len(originals)}: {told}") from error
            # answers stand beside the pairs that are still to come: their names tell nothing before the last call
            (kept / str(number)).mkdir()
            for file in ANSWER_FILES:
                if (answer / file).is_file():
                    shutil.copyfile(answer / file, kept / str(number) / file)
            remove(pair)
            remove(answer)
        for number, original in enumerate(originals):
            (answers / original.parent.name).mkdir(parents=True, exist_ok=True)
            (kept / str(number)).rename(answers / original.parent.name / original.name)
        add_predictions(folder, answers, name)
    results = read_table(folder.path / "results.csv")
    return results[results["variant"] == name]


def list_incomplete_variants(provenance: Mapping[str, Any], results: pd.DataFrame) -> list[str]:
    """Return one line for each variant outside the plan that lacks pairs of the run, naming the pairs."""
    plan = read_stored_plan(provenance)
    if plan is None:
        return []
    planned = {variant for _, _, variant in list_planned_cases(plan)}
    cases = [results["scenario"], results["seed"].astype(int)]
    every = dict.fromkeys(zip(*cases, strict=True))
    lines = []
    for variant in dict.fromkeys(set(results["variant"]) - planned):
        own = set(zip(*(column[results["variant"] == variant] for column in cases), strict=True))
        missing = [f"{scenario} {seed}" for scenario, seed in every if (scenario, seed) not in own]
        if missing:
            lines.append(
                f"{variant} has no answer for {_listed(missing)}: its means are over the other {len(own)} pairs"
            )
    return sorted(lines)


def _matched(run: RunFolder, folder: Path, pairs: Sequence[Path]) -> dict[Path, Path]:
    """Return the folder of the prediction for each pair of a run.

    Raises:
        InputError: A pair has none, or one is for no pair.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: expected {folder}/<scenario>/<seed>/answer.json")
    opaque = name_blindly(run)
    given = {file.parent for file in folder.glob("**/answer.json")}
    found: dict[Path, Path] = {}
    wanted: dict[Path, str] = {}
    known: set[Path] = set()
    mistakes: list[str] = []
    for pair in pairs:
        scenario = foreign_identity(run, pair.parent.name, pair.name, "")["scenario"]
        wanted[pair] = f"{scenario}/{pair.name}"
        # by the name of the scenario, by that of its folder in the run, or blind
        called = wanted[pair], f"{pair.parent.name}/{pair.name}", opaque.get(pair, wanted[pair])
        places = {folder / name for name in called} & given
        if len(places) > 1:
            mistakes.append(f"{' and '.join(map(str, sorted(places)))}: two predictions for one pair: leave one out")
        known |= places
        found.update((pair, place) for place in places)
    if given & {folder / name for name in opaque.values()}:
        wanted = opaque
    names = list(wanted.values())
    for place in sorted(given - known):
        near = suggest(str(place.relative_to(folder)), names)
        mistakes.append(f"{visible(str(place))}: the run has no such pair{near or f'; it has {_listed(names)}'}")
    if missing := [name for pair, name in wanted.items() if pair not in found]:
        mistakes.append(
            f"{folder}: no prediction for {_listed(missing)} of {run.path}: write "
            f'{folder}/{missing[0]}/answer.json, of status "failed" where there is no answer'
        )
    if mistakes:
        raise InputError("\n".join(mistakes))
    return found


def is_name_of_ours(name: str) -> bool:
    """Tell whether a preset or an oracle of tunnelcd is called so, or a reader of a table would take it for one."""
    seen = bare(name)
    return folded(seen.partition("[")[0].strip()) in map(folded, preset_names()) or folded(seen).startswith("oracle-")


def list_predicted(run: RunFolder, name: str) -> list[Path]:
    """Return the cells of a method whose answers came from elsewhere."""
    cells = (path for path in sorted(run.path.glob("cells/*/*/*.json")) if path.stem.casefold() == folded(name))
    return [path for path in cells if (stored := run.read_cell(path)) is not None and stored["key"] == NO_KEY]


def _require_not_evaluated(run: RunFolder, name: str) -> None:
    if (run.path / "evaluations" / path_part(name) / "evaluation.json").exists():
        raise InputError(f"--as {name}: a command was evaluated under this name: choose another")


def require_free_name(run: RunFolder, name: str) -> None:
    """Refuse the name of a variant of the run, of a preset or of an oracle, and one that would share its folder.

    Raises:
        InputError: It is one of them, or no table can hold it.
    """
    try:
        require_table_name(name)
    except ValueError as error:
        raise InputError(f"--as {name!r}: {error}") from error
    if is_name_of_ours(name):
        raise InputError(f"--as {name}: a preset or an oracle of tunnelcd is called so: choose another")
    for path in sorted(run.path.glob("cells/*/*/*.json")):
        if path.stem.casefold() == folded(name) and (stored := run.read_cell(path)) is not None:
            if stored["key"] != NO_KEY:
                raise InputError(f"--as {name}: the run has a variant of this name: choose another")
            if stored["row"]["variant"] != name:
                other = visible(str(stored["row"]["variant"]))
                raise InputError(f"--as {name}: would take the folder of the variant {other}: choose another")


def _find_unscored(run: RunFolder, identity: Mapping[str, Any], prediction: Path) -> list[str]:
    """Return the mistake that an answer of the name lies in the run without a score; no mistake if it is this one."""
    names = identity["scenario"], identity["seed"], identity["variant"]
    answer = run.answer(*names)
    is_scored = run.read_cell(run.cell(*names)) is not None
    _, others, unreadable = filecmp.cmpfiles(answer, prediction, ANSWER_FILES, shallow=False)
    if is_scored or not answer.exists() or not (others or any((answer / name).exists() for name in unreadable)):
        return []
    return [f"{answer}: holds an answer that is not scored: `tunnelcd score {run.path}` takes it in, or remove it"]


def require_current_scores(run: RunFolder) -> None:
    """Refuse a run that was scored by another metrics version.

    Raises:
        InputError: It was.
    """
    others = list_versions(cell["row"] for cell in run.each_cell()) - {str(METRICS_VERSION)}
    if others:
        told = " and ".join(sorted(others))
        raise InputError(
            f"{run.path}: has rows of metrics version {told}, but predictions are scored by {METRICS_VERSION}: "
            f"`tunnelcd score {run.path}` first, which scores all of it again"
        )


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _TOLD} more" if len(names) > _TOLD else ""
    return f"{', '.join(names[:_TOLD])}{more}"
