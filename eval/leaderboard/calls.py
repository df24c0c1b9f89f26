"""What is kept of the calls of an evaluated command, beside its rows.

    RUN/evaluations/<method>/evaluation.json        command, merge, time limit, plan; digests of the programs' files;
                                                    code, machine and packages that asked
    RUN/evaluations/<method>/<world>/<seed>.json    how the call ended: seconds, error, end of its standard error;
                                                    digests of the pair, of what was called and of what it answered

Answers and rows lie where those of the other variants of a run do.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json
from cdpipe.core.names import path_part
from cdpipe.core.plugins import extra_version
from cdpipe.core.yamlfile import Document, Settings, validate
from cdpipe.io.answer import ANSWER_FILES
from eval.core.provenance import digest
from eval.leaderboard.given_merge import MergeMode
from eval.plans.worlds import world_slug
from eval.running.pair_run import Pair
from eval.running.runfolder import RunFolder
from scenarios.references import without_paths

_EXPECTED = "--force answers all pairs again"


class Asker(Settings):
    """What asked pairs: the code (None where it is not known), the machine, and the versions of packages."""

    commit: str | None
    machine: Mapping[str, Any]
    versions: Mapping[str, str]


class EvaluationFile(Settings):
    """RUN/evaluations/<method>/evaluation.json.

    `pairs` are (scenario, seed) of the plan that was evaluated last. `askers` are all that asked pairs whose calls are
    kept, each once; () where an older tunnelcd did.
    """

    format: Literal["tunnelcd-evaluation"] = "tunnelcd-evaluation"
    format_version: Literal[1] = 1
    name: str
    command: tuple[str, ...]
    merge: MergeMode
    limit_s: float
    programs: Mapping[str, str]
    plan: str
    plan_digest: str
    split: str = ""
    pairs: tuple[tuple[str, int], ...]
    askers: tuple[Asker, ...] = ()


class CallFile(Settings):
    """RUN/evaluations/<method>/<world>/<seed>.json.

    `pair_digest` is "" where the pair cannot be made, `world_digest` (`digest_world`) where it can; `method_digest`
    (`digest_method`) and `answer_digest` (`digest_answer`) where an older tunnelcd called.
    """

    method_digest: str = ""
    answer_digest: str = ""
    world_digest: str = ""
    pair_digest: str
    seconds: Annotated[float, Field(ge=0)]
    error: str
    stderr: str


def evaluation_folder(run: RunFolder, name: str) -> Path:
    """Return the folder of what is kept of a method's calls."""
    return run.path / "evaluations" / path_part(name)


def evaluation_path(run: RunFolder, name: str) -> Path:
    """Return the file that says how a method was evaluated."""
    return evaluation_folder(run, name) / "evaluation.json"


def read_evaluation(run: RunFolder, name: str) -> EvaluationFile:
    """Read how a method was evaluated.

    Raises:
        InputError: It was not, or the file is damaged.
    """
    path = evaluation_path(run, name)
    return validate(EvaluationFile, Document(str(path), read_json(path, _EXPECTED)))


def list_merges(run: RunFolder) -> dict[str, MergeMode]:
    """Return what merge each method that was evaluated in a run was given."""
    found = (path.parent.name for path in sorted(run.path.glob("evaluations/*/evaluation.json")))
    return {each.name: each.merge for each in (read_evaluation(run, name) for name in found)}


def call_path(run: RunFolder, name: str, scenario: str, seed: int) -> Path:
    """Return the file of the call about a pair."""
    return evaluation_folder(run, name) / world_slug(scenario) / f"{seed}.json"


def read_call(run: RunFolder, name: str, scenario: str, seed: int) -> CallFile | None:
    """Read how the call about a pair ended; None where there was none, or its file is damaged."""
    return read_call_file(call_path(run, name, scenario, seed))


def read_call_file(path: Path) -> CallFile | None:
    """Read the file of a call; None where there is none, or it is damaged."""
    try:
        return validate(CallFile, Document(str(path), read_json(path, _EXPECTED)))
    except InputError:
        return None


def digest_pair(pair: Path) -> str:
    """Return the SHA-256 of the truth of a simulated pair: another simulation has another; "" without a pair."""
    truth = pair / "truth" / "changes.json"
    return hashlib.sha256(truth.read_bytes()).hexdigest() if truth.is_file() else ""


def digest_world(pair: Pair, commit: str | None) -> str:
    """Return a digest of a drawn world and of the code that builds it, by which a world that it refused is known."""
    drawn = None if pair.scenario is None else without_paths(pair.scenario.model_dump(mode="json"), pair.files)
    return digest({"world": drawn, "seed": pair.seed, "version": extra_version("tunnelcd"), "commit": commit})


def digest_answer(answer: Path) -> str:
    """Return a digest of the files of a stored answer."""
    files = (answer / name for name in ANSWER_FILES)
    return digest({path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()})


def is_exchanged(call: CallFile, answer: Path) -> bool:
    """Tell whether a stored answer is another one than the call left."""
    return bool(call.answer_digest) and call.answer_digest != digest_answer(answer)


def digest_method(evaluation: EvaluationFile) -> str:
    """Return a digest of all that makes two answers those of one method: command, programs, merge and time limit."""
    return digest(evaluation.model_dump(mode="json", include={"command", "programs", "merge", "limit_s"}))


def describe_calls(run: RunFolder, evaluation: EvaluationFile) -> dict[tuple[str, int], Mapping[str, Any]]:
    """Return how the call about each pair of the evaluation ended, by (scenario, seed)."""
    calls = {pair: read_call(run, evaluation.name, *pair) for pair in evaluation.pairs}
    return {pair: call.model_dump(mode="json") for pair, call in calls.items() if call is not None}


def require_an_answer(run: RunFolder, name: str) -> None:
    """Refuse an evaluation in which the command failed on every pair; its rows and calls stay.

    Raises:
        InputError: How the first call ended, and where all of them are kept.
    """
    pairs = read_evaluation(run, name).pairs
    errors = [call.error if (call := read_call(run, name, *pair)) else "" for pair in pairs]
    if pairs and all(errors):
        (world, seed), folder = pairs[0], evaluation_folder(run, name)
        raise InputError(
            f"{name}: no pair has an answer; {world} {seed}: {errors[0]}; {folder}/*/SEED.json hold what it said"
        )
