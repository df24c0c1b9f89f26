"""Evaluates the command of a method on the pairs of a plan, one blind pair at a time.

    RUN/pairs, answers, cells, results.csv, ...         a run folder: the method is one of its variants
    RUN/evaluations/<method>/evaluation.json, ...       what was called and how the calls ended (eval.leaderboard.calls)
    RUN/evaluations/<method>/table.csv, ...             the comparison (eval.leaderboard.comparison)

A call that crashes, runs out of time or leaves no answer, or none that can be one, is a row with its error. It scores
like every case without an answer. A pair is finished when its cell is of the present metrics and its call was of the
present command, about the present simulation, and its answer is the one that the command left.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from cdpipe.core.errors import InputError, MergeFailedError, TunnelcdError
from cdpipe.core.names import path_part
from cdpipe.io.answer import ANSWER_FILES, require_answer_sizes, write_failure
from eval.core.output import remove
from eval.core.provenance import digest, machine, versions
from eval.core.terminal.progress import RunProgress, Silent
from eval.leaderboard.calls import (
    Asker,
    CallFile,
    EvaluationFile,
    call_path,
    digest_answer,
    digest_method,
    digest_pair,
    digest_world,
    evaluation_folder,
    evaluation_path,
    is_exchanged,
    read_call,
    read_call_file,
    read_evaluation,
)
from eval.leaderboard.command import digest_programs, run_command
from eval.leaderboard.given_merge import MergeMode, write_merge
from eval.plans.plan import Plan
from eval.running.cell_file import LAST, NO_KEY, cell_document
from eval.running.export import copy_pair
from eval.running.pair_run import TOOLS, Pair, Tools, is_pair_dropped, pair_lock, score_unmade
from eval.running.predictions import list_predicted, require_current_scores, require_free_name
from eval.running.runfolder import RunFolder, write_json, write_tables
from eval.running.runner import is_simulated, list_plan_pairs, open_pair, start_provenance
from eval.running.stages.pair_stages import PairStages
from eval.scoring.scoring import METRICS_VERSION, CaseScore, score_stored
from eval.truth.ground_truth import GroundTruth

_MOST_ERROR = 2_000


@dataclass(frozen=True, slots=True)
class Method:
    """A method of others.

    Attributes:
        name: Its variant in the tables.
        command: Its words (`eval.leaderboard.command.parse_command`).
        merge: What merge it is given.
        limit_s: Time limit of one pair, wall clock.
    """

    name: str
    command: tuple[str, ...]
    merge: MergeMode = "own"
    limit_s: float = 600.0


@dataclass(frozen=True, slots=True)
class EvaluationOutcome:
    """How an evaluation ended: pairs answered now, kept from earlier, and those without an answer.

    Of these, `n_failed` are of all pairs and `n_failed_kept` of those that were kept.
    """

    n_done: int
    n_kept: int
    n_failed: int
    n_failed_kept: int = 0


def evaluate_command(
    plan: Plan,
    run: RunFolder,
    method: Method,
    *,
    command: Sequence[str] = (),
    force: bool = False,
    progress: RunProgress | None = None,
    tools: Tools = TOOLS,
) -> EvaluationOutcome:
    """Let a command answer the pairs of a plan, score its answers and write the tables of the run.

    Args:
        plan: The plan; its own methods are not run.
        run: The folder; pairs that it holds are used, finished ones of the method are kept.
        method: The method.
        command: The command line, for the provenance.
        force: Answer finished pairs again.
        progress: Receives the progress.
        tools: What draws and simulates worlds.

    Raises:
        InputError: The name is taken, the method was evaluated with another command, or the folder cannot be used.
    """
    progress = progress or Silent()
    require_free_name(run, method.name)
    require_current_scores(run)
    pairs = list_plan_pairs(plan, run, tools)
    start_provenance(plan, run, command, tools)
    document = _take_over(run, method, plan, pairs, force=force)
    called = digest_method(document)
    todo = [pair for pair in pairs if force or not _is_finished(run, method, pair, called, tools.commit())]
    if todo:
        _note_asker(run, document, tools)
    # the order of a plan would tell which world a pair is of; a seed would, too
    random.SystemRandom().shuffle(todo)
    for done, pair in enumerate(todo):
        progress.cells(f"{pair.name} {pair.seed}", done, len(todo))
        with pair_lock(run, pair):
            error = _evaluate_pair(run, method, pair, called, progress, tools)
        if error:
            progress.note(f"{pair.name} {pair.seed}: {error}")
    progress.cells("done", len(todo), len(todo))
    results = write_tables(run)
    own = results[results["variant"] == method.name]
    failed = own[own["status"] != "ok"]
    failed_pairs = set(zip(failed["scenario"], failed["seed"], strict=True))
    counts = [sum((pair.name, pair.seed) in failed_pairs for pair in some) for some in (pairs, todo)]
    return EvaluationOutcome(len(todo), len(pairs) - len(todo), counts[0], counts[0] - counts[1])


def _take_over(run: RunFolder, method: Method, plan: Plan, pairs: Sequence[Pair], *, force: bool) -> EvaluationFile:
    """Write evaluation.json; refuse to mix rows of two commands under one name, or remove those of the other one."""
    document = EvaluationFile(
        name=method.name, command=method.command, merge=method.merge, limit_s=method.limit_s,
        programs=digest_programs(method.command), plan=plan.name, plan_digest=digest(plan.model_dump(mode="json")),
        split=plan.split, pairs=tuple((pair.name, pair.seed) for pair in pairs),
    )  # fmt: skip
    path = evaluation_path(run, method.name)
    earlier = _read_earlier(run, method.name, force=force) if path.exists() else None
    if earlier is None and not force and (others := list_predicted(run, method.name)):
        raise InputError(
            f"--as {method.name}: {len(others)} answers of this name came from elsewhere: give another name, or "
            "--force, which removes them"
        )
    if earlier is not None and not force:
        for name, told in (("command", "--command"), ("merge", "--merge"), ("limit_s", "--time-limit")):
            if (was := getattr(earlier, name)) != getattr(document, name):
                shown = " ".join(was) if isinstance(was, tuple) else was
                raise InputError(
                    f"--as {method.name}: its rows are of {told} {shown!r}: give that, another name, or --force, which "
                    "answers all pairs again"
                )
        if changed := [name for name, value in document.programs.items() if earlier.programs.get(name) != value]:
            raise InputError(
                f"--as {method.name}: {changed[0]} was changed since its rows were made: give another name, or "
                "--force, which answers all pairs again"
            )
    if force:
        is_changed = _remove_stale(run, method.name, digest_method(document), pairs)
        if is_changed:  # no table holds the rows of another call while this one answers
            _renew_tables(run)
    if earlier is not None and any(path.parent.glob("*/*.json")):  # of calls that are kept
        document = document.model_copy(update={"askers": earlier.askers})
    write_json(path, document.model_dump(mode="json"))
    return document


def _read_earlier(run: RunFolder, name: str, *, force: bool) -> EvaluationFile | None:
    """Read evaluation.json; a damaged one counts as none where all pairs are asked again."""
    try:
        return read_evaluation(run, name)
    except InputError:
        if force:
            return None
        raise


def _note_asker(run: RunFolder, document: EvaluationFile, tools: Tools) -> None:
    """Add this process to those that evaluation.json says asked pairs, unless nothing is known of calls before it."""
    path = evaluation_path(run, document.name)
    if not document.askers and any(path.parent.glob("*/*.json")):
        return
    asker = Asker(commit=tools.commit(), machine=machine(), versions=versions())
    if asker not in document.askers:
        document = document.model_copy(update={"askers": (*document.askers, asker)})
        write_json(path, document.model_dump(mode="json"))


def _renew_tables(run: RunFolder) -> None:
    """Write the tables of the cells that are left; without cells there is none."""
    if any(True for _ in run.each_cell()):
        write_tables(run)
        return
    for table in sorted(run.path.glob("*.csv")):
        remove(table)


def _remove_stale(run: RunFolder, name: str, called: str, pairs: Sequence[Pair]) -> bool:
    """Remove the rows, answers and comparisons under a name about pairs that are asked again.

    Those that are not of the method with this digest go as well, also of other plans. After an interrupt nothing is
    left that would count as answered now. Tells whether there were any.
    """
    calls, is_changed = evaluation_folder(run, name), False
    asked = {call_path(run, name, pair.name, pair.seed) for pair in pairs}

    def is_stale(path: Path) -> bool:
        call = None if path in asked else read_call_file(path)
        return call is None or call.method_digest != called

    for kind, entry in (("cells", f"{path_part(name)}.json"), ("answers", path_part(name))):
        for pair in run.path.glob(f"{kind}/*/*"):
            if (pair / entry).exists() and is_stale(calls / pair.parent.name / f"{pair.name}.json"):
                remove(pair / entry)
                is_changed = True
    for path in calls.glob("*/*.json"):
        if is_stale(path):
            remove(path)
    if is_changed:
        for path in calls.glob("*.csv"):
            remove(path)
    return is_changed


def _is_finished(run: RunFolder, method: Method, pair: Pair, called: str, commit: str | None) -> bool:
    call = read_call(run, method.name, pair.name, pair.seed)
    cell = run.read_cell(run.cell(pair.name, pair.seed, method.name))
    if call is None or cell is None or cell["row"].get("metrics_version") != METRICS_VERSION:
        return False
    if is_exchanged(call, run.answer(pair.name, pair.seed, method.name)):
        return False
    return call.method_digest == called and _is_about(run, pair, call, commit)


def _is_about(run: RunFolder, pair: Pair, call: CallFile, commit: str | None) -> bool:
    """Tell whether a call was about the present world of a pair, as its sessions or the record of removed ones tell.

    A pair that could not be made is one where its seed draws nothing for the same reason, or the same world, which
    this code refused to build.
    """
    if not call.pair_digest and pair.scenario is None:
        return call.error == pair.error
    if not call.pair_digest:
        return call.world_digest == digest_world(pair, commit)
    held = run.pair(pair.name, pair.seed)
    return is_pair_dropped(run, pair) is True or (call.pair_digest == digest_pair(held) and is_simulated(held, pair))


def _evaluate_pair(run: RunFolder, method: Method, pair: Pair, called: str, progress: RunProgress, tools: Tools) -> str:
    """Make a pair, answer it and write its cell; returns why there is no answer, "" where there is one."""
    folder, path = run.answer(pair.name, pair.seed, method.name), call_path(run, method.name, pair.name, pair.seed)
    for stale in (run.cell(pair.name, pair.seed, method.name), path, folder):
        remove(stale)
    opened = open_pair(run, pair, progress, tools)
    if isinstance(opened, str):
        refused = digest_world(pair, tools.commit())
        call = CallFile(pair_digest="", world_digest=refused, seconds=0.0, error=opened, stderr="")
        score = score_unmade(pair, "failed", opened)
    else:
        progress.stage("command", 0, 1)
        call = _call(run, method, pair, opened, folder)
        call, score = _score(method, opened[1], folder, call)
    names = {"scenario": pair.name, "seed": pair.seed, "variant": method.name, "preset": method.name}
    identity = {**names, "pair_kind": pair.kind, "commit": None, "is_contended": False}
    digests = {"method_digest": called, "answer_digest": digest_answer(folder)}
    write_json(path, {**call.model_dump(mode="json"), **digests})
    write_json(run.cell(pair.name, pair.seed, method.name), cell_document(score, identity, NO_KEY, LAST))
    return call.error


def _call(run: RunFolder, method: Method, pair: Pair, opened: tuple[PairStages, GroundTruth], answer: Path) -> CallFile:
    """Call the command about a pair and store its answer, or a failure."""
    original = run.pair(pair.name, pair.seed)
    known = digest_pair(original)
    with _places() as places:
        try:
            write_merge(places["merge"], method.merge, *opened)
        except (MergeFailedError, InputError) as reason:
            told = ("merge_refused", reason.evidence) if isinstance(reason, MergeFailedError) else ("failed", {})
            write_failure(answer, method.name, told[0], str(reason), told[1], {})
            return CallFile(pair_digest=known, seconds=0.0, error=str(reason)[:_MOST_ERROR], stderr="")
        copy_pair(original, places["before"].parent)
        ended = run_command(method.command, places, places["work"], method.limit_s)
        error = ended.error or _find_no_answer(places["out"])
        if error:
            write_failure(answer, method.name, "failed", error, {}, {})
        else:
            answer.mkdir(parents=True)
            for name in ANSWER_FILES:
                if (places["out"] / name).is_file():
                    shutil.copyfile(places["out"] / name, answer / name)
    return CallFile(pair_digest=known, seconds=ended.seconds, error=error, stderr=ended.stderr)


def _find_no_answer(out: Path) -> str:
    """Return why a folder that a command left holds no answer to be copied, "" where it does."""
    if not (out / "answer.json").is_file():
        return "the command ended well and left no {out}/answer.json"
    try:
        require_answer_sizes(out)  # a copy of what no reader takes could fill the disk
    except InputError as mistake:
        return f"no valid answer: {str(mistake).replace(f'{out}/', '')}"
    return ""


def _score(method: Method, truth: GroundTruth, folder: Path, call: CallFile) -> tuple[CallFile, CaseScore]:
    """Score the answer in a folder; one that cannot be an answer to the pair becomes a failure."""
    try:
        score = score_stored(truth, folder)
    except TunnelcdError as mistake:
        told = "; ".join(str(mistake).replace(f"{folder}/", "").replace(str(folder), "the answer").split("\n"))
        error = f"no valid answer: {told}"[:_MOST_ERROR]
        remove(folder)
        write_failure(folder, method.name, "failed", error, {}, {})
        call, score = call.model_copy(update={"error": error}), score_stored(truth, folder)
    if score.row["status"] != "ok" and not call.error:
        call = call.model_copy(update={"error": f"{score.row['status']}: {score.row['error']}"})
    return call, score


@contextmanager
def _places() -> Iterator[dict[str, Path]]:
    """Yield what stands for the placeholders, and a working folder, in a folder that is removed at the end."""
    with TemporaryDirectory(prefix="tunnelcd-", ignore_cleanup_errors=True) as folder:
        places = {name: Path(folder) / name for name in ("work", "out")}
        for path in places.values():
            path.mkdir()
        pair = Path(folder) / "pair"
        pair.mkdir()
        sessions = {name: pair / name for name in ("before", "after")}
        yield {**places, **sessions, "merge": Path(folder) / "merge.json"}
