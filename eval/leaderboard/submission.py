"""Packed results of a method (`eval.leaderboard.packing`): one zip file with rows, answers, where they come from.

    submission.json                      method, plan, versions, and of each pair its row and the digests of its answer
    answers/<number of the pair>/answer.json, answer.npz

The names of the members follow from the number of the pair, so no name of a file leads anywhere. Digests show damage
and mixed-up files; who wants to know whether the rows are those of the answers scores them again (`score_again`).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field

from cdpipe.core.errors import InputError
from cdpipe.core.files import opened_zip, parse_json, read_member, require_plain_file
from cdpipe.core.names import LONGEST, visible
from cdpipe.core.yamlfile import Document, Settings, validate
from cdpipe.io.answer import ANSWER_FILES
from cdpipe.io.answer_parts import MAX_ERROR
from eval.core.provenance import digest_file
from eval.leaderboard.calls import digest_pair
from eval.leaderboard.given_merge import MergeMode
from eval.plans.worlds import world_slug
from eval.running.cell_rows import TEXT_COLUMNS
from eval.running.predictions import is_name_of_ours
from eval.running.results.tables import LARGEST
from eval.running.runfolder import RunFolder
from eval.scoring.scoring import METRICS_VERSION, score_stored
from eval.truth.ground_truth import load_ground_truth

MANIFEST = "submission.json"
MOST_BYTES = 4 << 30
_EXPECTED = "expected a file that `tunnelcd submit DIR --out FILE.zip` makes"
_ROUNDING = 1e-6
# columns of a row that say who answered what, which scoring does not know
_NAMES = {"scenario", "seed", "variant", "preset", "pair_kind", "commit"}
# columns of numbers in the row of a pair that cannot be made; others would be figures
_UNMADE = {"seed", "metrics_version", "is_contended"}
_TRUTH_VALUES = {"is_unchanged_pair", "is_alarm", "is_contended", "is_auroc_assumed"}
_Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
_Text = Annotated[str, Field(max_length=MAX_ERROR)]
_Name = Annotated[str, Field(min_length=1, max_length=LONGEST)]


def _require_scalar(value: Any) -> Any:
    if value is not None and not isinstance(value, bool | int | float | str):
        raise ValueError("expected a number, a truth value, a text or nothing")
    if isinstance(value, str) and len(value) > MAX_ERROR:
        raise ValueError(f"expected at most {MAX_ERROR} letters")
    return value


Cell = Annotated[Any, AfterValidator(_require_scalar)]


class FilePart(Settings):
    """One file of an answer."""

    sha256: _Digest
    n_bytes: Annotated[int, Field(ge=0)]


class PairPart(Settings):
    """One pair: its row of results.csv, and the files of its answer; none where the pair cannot be made."""

    model_config = ConfigDict(allow_inf_nan=True)  # a figure that is undefined is NaN

    scenario: _Name
    seed: Annotated[int, Field(ge=0)]
    pair_digest: Literal[""] | _Digest
    seconds: Annotated[float, Field(ge=0, le=1e8)]
    row: Annotated[dict[_Name, Cell], Field(max_length=1_000)]
    files: dict[Literal["answer.json", "answer.npz"], FilePart]


class Submission(Settings):
    """submission.json."""

    format: Literal["tunnelcd-submission"] = "tunnelcd-submission"
    format_version: Literal[1] = 1
    name: _Name
    command: Annotated[list[_Text], Field(min_length=1, max_length=1_000)]
    merge: MergeMode
    limit_s: Annotated[float, Field(gt=0, le=1e8)]
    programs: Annotated[dict[_Name, _Digest], Field(max_length=1_000)]
    plan: _Name
    split: Annotated[str, Field(max_length=LONGEST)] = ""
    metrics_version: int
    commit: Annotated[str, Field(max_length=LONGEST)] | None
    machine: Annotated[dict[_Name, Any], Field(max_length=100)]
    versions: Annotated[dict[_Name, _Text], Field(max_length=1_000)]
    pairs: Annotated[list[PairPart], Field(min_length=1, max_length=100_000)]


@dataclass(frozen=True, slots=True, eq=False)
class CheckedFile:
    """A submission whose digests are right.

    Attributes:
        path: Its file.
        sha256: The digest of the file.
        content: Its content; rows that were scored again are those of the scoring.
        n_checked: How many pairs were scored again.
    """

    path: Path
    sha256: str
    content: Submission
    n_checked: int = 0


def read_submission(path: Path) -> CheckedFile:
    """Read a packed submission and compare all digests; nothing is written.

    Raises:
        InputError: It is damaged, not complete, or of another metrics version.
    """
    n_bytes = require_plain_file(path, MOST_BYTES, _EXPECTED)
    with opened_zip(path, n_bytes, _EXPECTED) as (archive, members):
        if MANIFEST not in members:
            raise ValueError(f"no {MANIFEST} in it")
        content = parse_json(read_member(archive, members[MANIFEST]).tobytes())
        document = validate(Submission, Document(f"{path}:{MANIFEST}", content))
        check_rows(document)
        declared = {
            member_name(number, file): part
            for number, pair in enumerate(document.pairs)
            for file, part in pair.files.items()
        }
        if others := sorted({*members} ^ {*declared, MANIFEST})[:1]:
            raise ValueError(f"{visible(others[0])[:200]} is in the archive or in {MANIFEST}, not in both")
        for name, part in declared.items():
            if members[name].file_size != part.n_bytes:
                raise ValueError(f"{name} has {members[name].file_size} bytes, {part.n_bytes} were packed")
            if hashlib.sha256(read_member(archive, members[name]).data).hexdigest() != part.sha256:
                raise ValueError(f"{name} is not the file that was packed: its digest differs")
    return CheckedFile(path, digest_file(path), document)


def score_again(found: CheckedFile, run: RunFolder) -> CheckedFile:
    """Score the answers of a submission by the truth of a run's pairs, and compare the rows.

    Args:
        found: The submission.
        run: A run folder with the same pairs.

    Returns:
        The submission with the rows that scoring gave: what is within rounding may still decide between two methods.
        A pair that cannot be made has no answer and, as `read_submission` saw, no figure; its row stays.

    Raises:
        InputError: The run lacks a pair, has another name for it or holds another simulation of it, or one of a pair
            that has no answer as it cannot be made; or a row is not that of its answer.
    """
    _require_names_of(run, found)
    pairs: list[PairPart] = []
    for pair, files in _iterate_answers(found):
        original, case = run.pair(pair.scenario, pair.seed), f"{pair.scenario} {pair.seed}"
        if not files:
            if digest_pair(original):
                raise InputError(
                    f"{found.path}: {case}: no answer, as a pair that cannot be made; {run.path} holds it: evaluate "
                    "and submit again"
                )
            pairs.append(pair)
            continue
        if digest_pair(original) != pair.pair_digest:
            raise InputError(f"{run.path}: holds no pair {case} as {found.path} answers it: simulate it anew")
        with TemporaryDirectory(prefix="tunnelcd-") as answer:
            for name, content in files.items():
                Path(answer, name).write_bytes(content)
            score = score_stored(load_ground_truth(original), Path(answer))
        scored = {key: _plain(value) for key, value in score.row.items() if key not in _NAMES}
        for key, value in scored.items():
            if key not in score.plugins and not _is_same(pair.row.get(key), value):
                raise InputError(
                    f"{found.path}: {case}: {key} = {pair.row.get(key)} in its row, and its answer scores {value}"
                )
        own = {key: value for key, value in pair.row.items() if key in _NAMES}
        pairs.append(pair.model_copy(update={"row": {**own, **scored}}))
    n_scored = sum(bool(pair.files) for pair in pairs)
    return replace(found, content=found.content.model_copy(update={"pairs": pairs}), n_checked=n_scored)


def _require_names_of(run: RunFolder, found: CheckedFile) -> None:
    """Refuse other names of worlds than the run has for them: they lead to one folder, and stand apart in tables."""
    for pair in {pair.scenario: pair for pair in found.content.pairs}.values():
        row = run.any_row(world_slug(pair.scenario))
        if row is not None and row["scenario"] != pair.scenario:
            told = f"{found.path}: {visible(pair.scenario)} {pair.seed}"
            raise InputError(f"{told}: is called {visible(row['scenario'])} in {run.path}: evaluate the same plan")


def _iterate_answers(found: CheckedFile) -> Iterator[tuple[PairPart, dict[str, bytes]]]:
    """Yield each pair and the content of the files of its answer."""
    with opened_zip(found.path, found.path.stat().st_size, _EXPECTED) as (archive, members):
        for number, pair in enumerate(found.content.pairs):
            names = {file: members[member_name(number, file)] for file in pair.files}
            yield pair, {file: read_member(archive, member).tobytes() for file, member in names.items()}


def check_rows(document: Submission) -> None:
    """Refuse rows that are not of their pairs, and values that no table can hold."""
    if document.metrics_version != METRICS_VERSION:
        raise ValueError(
            f"scored by metrics version {document.metrics_version}, this tunnelcd scores by {METRICS_VERSION}"
        )
    if is_name_of_ours(document.name):
        raise ValueError(
            f"a preset or an oracle of tunnelcd is called {visible(document.name)}: another name is needed"
        )
    seen = set()
    for pair in document.pairs:
        # two names of a world may lead to one folder of pairs
        case = world_slug(pair.scenario).casefold(), pair.seed
        if case in seen or (pair.row.get("scenario"), pair.row.get("seed")) != (pair.scenario, pair.seed):
            raise ValueError(f"the row of {visible(pair.scenario)} {pair.seed} stands twice, or is of another pair")
        seen.add(case)
        if pair.row.get("variant") != document.name or pair.row.get("metrics_version") != METRICS_VERSION:
            raise ValueError(f"the row of {visible(pair.scenario)} {pair.seed} is of another method or other metrics")
        is_ok = pair.row.get("status") == "ok"
        if not isinstance(pair.row.get("status"), str) or (is_ok and set(pair.files) != set(ANSWER_FILES)):
            raise ValueError(f"the row of {visible(pair.scenario)} {pair.seed} has no status, or no answer")
        if not pair.files:
            _require_no_figures(pair)
        for key, value in pair.row.items():
            if isinstance(value, str) and key not in TEXT_COLUMNS:
                raise ValueError(f"{visible(key)[:40]} = {value[:40]!r}: expected a number")
            if isinstance(value, float) and abs(value) > LARGEST:
                raise ValueError(f"{visible(key)[:40]} = {value}: larger than any figure is")
            if key in _TRUTH_VALUES and not (value is None or value in (0, 1) or math.isnan(value)):
                raise ValueError(f"{key} = {value}: expected a truth value")


def _require_no_figures(pair: PairPart) -> None:
    """Refuse figures of a pair that has no answer: such a pair cannot be made, and what it scores is undefined."""
    case = f"{visible(pair.scenario)} {pair.seed}"
    if pair.pair_digest:
        raise ValueError(f"the pair {case} was made, and there is no answer to it")
    for key, value in pair.row.items():
        is_nothing = value is None or isinstance(value, str) or (isinstance(value, float) and math.isnan(value))
        if not is_nothing and key not in _UNMADE:
            raise ValueError(f"{case}: {visible(key)[:40]} = {value} in its row, and there is no answer to it")


def member_name(number: int, file: str) -> str:
    """Return the name in the archive of a file of the answer to a pair."""
    return f"answers/{number:05d}/{file}"


def _plain(scored: Any) -> Any:
    """Return a value of a row that scoring gave as a row in a file holds it."""
    return json.loads(json.dumps(scored, default=lambda value: value.item()))


def _is_same(stored: Any, plain: Any) -> bool:
    """Tell whether a value of a row is what scoring gave."""
    if isinstance(plain, str) or plain is None:
        return bool(stored == plain)
    if not isinstance(stored, bool | int | float):
        return False
    a, b = float(stored), float(plain)
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
