"""Packs what an evaluated method answered into one file, which `eval.leaderboard.submission` reads."""

from __future__ import annotations

import hashlib
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_json, read_bytes
from cdpipe.core.names import path_part, visible
from cdpipe.core.whole_file import whole_file
from cdpipe.core.yamlfile import Document, validate
from cdpipe.io.answer import ANSWER_FILES
from eval.core.output import made_parents, require_replaceable, unwritable
from eval.leaderboard.calls import (
    Asker,
    EvaluationFile,
    digest_method,
    digest_pair,
    is_exchanged,
    list_merges,
    read_call,
    read_evaluation,
)
from eval.leaderboard.submission import (
    MANIFEST,
    MOST_BYTES,
    PairPart,
    Submission,
    check_rows,
    member_name,
)
from eval.running.runfolder import RunFolder, json_text
from eval.running.scaling.merged_provenance import unite_fields
from eval.scoring.scoring import METRICS_VERSION

_HEAD = MANIFEST.encode()  # the name of the first member stands near the start of the file
_TOLD = 3


def pack_submission(run: RunFolder, name: str, out: Path) -> int:
    """Pack the results of an evaluated method.

    Args:
        run: The run folder.
        name: The method; "" for the only one that was evaluated there.
        out: The zip file.

    Returns:
        How many pairs it holds.

    Raises:
        InputError: Pairs lack an answer or its row, or these are not of the present pairs or metrics; or `out` cannot
            be written.
    """
    if out.suffix != ".zip" or out.is_dir():
        raise InputError(f"--out {out}: expected the name of a new file that ends in .zip")
    require_replaceable(out, _HEAD, "file of `tunnelcd submit`")
    evaluation = read_evaluation(run, _find_method(run, name))
    parts, answers = _collect(run, evaluation)
    told = {
        "name": evaluation.name, "command": [_without_folders(word) for word in evaluation.command],
        "merge": evaluation.merge, "limit_s": evaluation.limit_s,
        "programs": _name_programs(evaluation.programs),
        "plan": evaluation.plan, "split": evaluation.split, "metrics_version": METRICS_VERSION,
        **_unite_askers(evaluation.askers), "pairs": parts,
    }  # fmt: skip
    document = validate(Submission, Document(f"{run.path}: {evaluation.name}", told))
    manifest = json_text(document.model_dump()).encode()
    _require_readable(f"{run.path}: {evaluation.name}", manifest, document)
    try:
        with made_parents(out), whole_file(out) as partial, zipfile.ZipFile(partial, "w") as archive:
            _add(archive, MANIFEST, manifest)
            for number, answer in enumerate(answers):
                for file in parts[number].files:
                    _add(archive, member_name(number, file), (answer / file).read_bytes())
    except OSError as error:
        raise unwritable(out, error) from error
    return len(parts)


def _require_readable(name: str, manifest: bytes, document: Submission) -> None:
    """Refuse to pack what `read_submission` would not read."""
    n_bytes = len(manifest) + sum(part.n_bytes for pair in document.pairs for part in pair.files.values())
    try:
        check_rows(document)
    except ValueError as error:
        raise InputError(f"{name}: {error}: a leaderboard would not read it") from error
    try:
        parse_json(manifest)
        if n_bytes > MOST_BYTES:
            raise ValueError(f"{n_bytes >> 20} MB, more than the {MOST_BYTES >> 20} MB that a file may have")
    except ValueError as error:
        raise InputError(
            f"{name}: {len(document.pairs)} pairs are too many for one file ({error}): evaluate parts of the plan "
            "(--seeds) in folders of their own, and submit each"
        ) from error


def _unite_askers(askers: Sequence[Asker]) -> dict[str, Any]:
    """Return code, machine and packages that asked; fields that differ name all. Older evaluations did not tell."""
    commits = {each.commit for each in askers}
    return {
        "commit": commits.pop() if len(commits) == 1 else None,
        "machine": unite_fields([each.machine for each in askers]),
        "versions": unite_fields([each.versions for each in askers]),
    }


def _name_programs(programs: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of programs by their names without folders; of equal names the later ones get a number."""
    named: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for path, found in programs.items():
        name = _without_folders(path)
        counts[name] += 1
        named[name if counts[name] == 1 else f"{name} ({counts[name]})"] = found
    return named


def _collect(run: RunFolder, evaluation: EvaluationFile) -> tuple[list[PairPart], list[Path]]:
    """Return the parts and the folders of all answers; refuse to pack some of them only."""
    parts, answers, mistakes, called = [], [], [], digest_method(evaluation)
    for scenario, seed in evaluation.pairs:
        answer = run.answer(scenario, seed, evaluation.name)
        call = read_call(run, evaluation.name, scenario, seed)
        cell = run.read_cell(run.cell(scenario, seed, evaluation.name))
        held = digest_pair(run.pair(scenario, seed))
        has_answer = (answer / ANSWER_FILES[0]).is_file()
        is_there = call is not None and cell is not None and (not call.pair_digest or has_answer)
        if call is None or cell is None or not is_there or cell["row"].get("metrics_version") != METRICS_VERSION:
            mistakes.append(f"{scenario} {seed}")
        elif call.method_digest != called:
            mistakes.append(f"{scenario} {seed} (of another command)")
        elif held and held != call.pair_digest:
            mistakes.append(f"{scenario} {seed} (simulated anew since)")
        elif is_exchanged(call, answer):
            mistakes.append(f"{scenario} {seed} (its answer was exchanged)")
        else:
            files = {file: _describe(answer / file) for file in ANSWER_FILES if (answer / file).is_file()}
            part = {"scenario": scenario, "seed": seed, "pair_digest": call.pair_digest, "seconds": call.seconds,
                    "row": cell["row"], "files": files}  # fmt: skip
            parts.append(validate(PairPart, Document(f"{run.path}: {scenario} {seed}", part)))
            answers.append(answer)
    if mistakes:
        more = f" and {len(mistakes) - _TOLD} more" if len(mistakes) > _TOLD else ""
        raise InputError(
            f"{run.path}: {evaluation.name} lacks {len(mistakes)} of {len(evaluation.pairs)} pairs "
            f"({', '.join(mistakes[:_TOLD])}{more}): the same `tunnelcd evaluate` goes on there"
        )
    return parts, answers


def _find_method(run: RunFolder, name: str) -> str:
    parts = [path.parent.name for path in sorted(run.path.glob("evaluations/*/evaluation.json"))]
    if not parts:
        raise InputError(f"{run.path}: no method was evaluated here: `tunnelcd evaluate --out {run.path}` first")
    if path_part(name) in parts or (not name and len(parts) == 1):
        return name or parts[0]
    told = ", ".join(map(visible, list_merges(run)))
    if name:
        raise InputError(f"{run.path}: --as {name}: no method of this name was evaluated here, but {told}")
    raise InputError(f"{run.path}: holds {told}: name one with --as")


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a member that carries no time, so that the same results give the same bytes."""
    archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED if name.endswith(".json") else None)


def _describe(path: Path) -> dict[str, Any]:
    content = read_bytes(path)
    return {"sha256": hashlib.sha256(content).hexdigest(), "n_bytes": len(content)}


def _without_folders(word: str) -> str:
    """Return a word of a command without the folders of this machine: `/a/b.py` is `b.py`, `--w=/a/b` is `--w=b`."""
    name, sign, value = ("", "", word) if Path(word).is_absolute() else word.partition("=")
    return f"{name}{sign}{Path(value).name}" if Path(value).is_absolute() else word
