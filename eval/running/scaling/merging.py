"""Unites run folders of one plan: the shards of a run, or parts of it that machines made.

Every finished cell comes into the new folder once, with its answer. A cell that two folders hold must be the same in
both: its key, its row and items, and its answer where both have one, times apart. So must the sessions of a pair. What
`tunnelcd evaluate` keeps comes along, and so do sessions and maps, as hard links where the disks allow it, else as
copies. Stored stages and the names of `tunnelcd export` stay behind. The new folder appears when it is complete.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json, read_npz
from cdpipe.io.answer import ANSWER_FILES
from eval.core.output import copy_folder, new_folder
from eval.core.provenance import digest, now
from eval.core.terminal.progress import RunProgress, Silent
from eval.plans.cells import list_planned_cases
from eval.plans.coverage import explain_unreadable_plan, read_stored_plan
from eval.running.cell_rows import ITEM_TABLES, SURFACE_TABLES
from eval.running.runfolder import RunFolder, open_run_folder, write_json, write_tables
from eval.running.scaling.keeping import digest_files, list_records, read_dropped
from eval.running.scaling.merged_provenance import unite_provenance
from eval.running.scaling.shards import number_pairs, stored_shard

# what two answers of one method share (`eval.leaderboard.calls.digest_method`), and the plan that they are of
_OF_A_METHOD = ("command", "programs", "merge", "limit_s", "plan", "plan_digest", "split")

_PAIRS: TypeAdapter[list[tuple[str, int]]] = TypeAdapter(list[tuple[str, int]])


@dataclass(frozen=True, slots=True)
class Union:
    """What was united.

    Attributes:
        n_cells: Finished cells in the new folder.
        n_shared: Of them, those that several folders held.
        notes: What a reader should know: shards and pairs that are missing, code that differs.
    """

    n_cells: int
    n_shared: int
    notes: tuple[str, ...]


def merge_runs(
    folders: Sequence[Path],
    out: Path,
    *,
    command: str = "",
    names: Sequence[str] = (),
    keep: Literal["sessions", "answers"] = "sessions",
    progress: RunProgress | None = None,
) -> Union:
    """Unite run folders into a new one, and write its tables.

    Args:
        folders: Two or more run folders of one plan.
        out: A new or empty folder.
        command: The command line, for the provenance.
        names: What the provenance calls the folders, else their paths.
        keep: Whether sessions and maps come along.
        progress: Receives the progress.

    Raises:
        InputError: A folder is no run, the runs are not of one plan, version, machine setting or set of weights, a cell
            or a pair differs between two of them, none is finished, or `out` holds something.
    """
    runs, progress = _open_runs(folders), progress or Silent()
    told = [run.provenance() for run in runs]
    provenance, notes = unite_provenance(list(names) or [str(run.path) for run in runs], told, command)
    _require_outside(out, runs)
    evaluations = _unite_evaluations(runs)
    sources, n_shared = _find_cells(runs, progress)
    _require_same_pairs(runs, progress)
    with new_folder(out) as partial:
        merged = RunFolder(partial)
        write_json(partial / "provenance.json", {**provenance, "finished": None})
        for done, (name, run) in enumerate(sources.items()):
            progress.cells(name, done, len(sources))
            _take_cell(run.path, partial, Path(name))
        if keep == "sessions":
            _take_pairs(runs, partial, progress)
        _take_records(runs, partial)
        _take_evaluations(runs, evaluations, sources, partial)
        write_tables(merged)
        write_json(partial / "provenance.json", {**provenance, "finished": now()})
    progress.cells("done", len(sources), len(sources))
    return Union(len(sources), n_shared, (*notes, *_missing(RunFolder(out), told)))


def _open_runs(folders: Sequence[Path]) -> list[RunFolder]:
    if len(folders) < 2:
        raise InputError("merge-runs unites two run folders or more: name them all")
    runs = [open_run_folder(folder) for folder in folders]
    places = Counter(run.path.resolve() for run in runs)
    if twice := [str(path) for path, n in places.items() if n > 1]:
        raise InputError(f"{twice[0]}: is named twice: name each run folder once")
    return runs


def _require_outside(out: Path, runs: Sequence[RunFolder]) -> None:
    place = Path(os.path.realpath(out))
    for run in runs:
        if place.is_relative_to(run.path.resolve()):
            raise InputError(f"{out}: lies in the run folder {run.path}: name a folder outside of it")


def _find_cells(runs: Sequence[RunFolder], progress: RunProgress) -> tuple[dict[str, RunFolder], int]:
    """Return the run that gives each finished cell, by the cell's file, and how many cells several runs hold."""
    sources: dict[str, RunFolder] = {}
    seen: dict[str, str] = {}
    shared, versions = set(), dict[str, Path]()
    for place, run in enumerate(runs):
        progress.stage("cells compared", place, len(runs))
        for path in sorted(run.path.glob("cells/*/*/*.json")):
            name = path.relative_to(run.path).as_posix()
            cell = run.read_cell(path)
            if cell is None:
                continue
            _require_one_name(seen, name, cell, run)
            if name in sources:
                _require_same(name, sources[name], run, cell)
                shared.add(name)
            if name not in sources or not (sources[name].path / _answer_of(name)).is_dir():
                sources[name] = run
            versions.setdefault(str(cell["row"].get("metrics_version")), run.path)
    if len(versions) > 1:
        told = ", ".join(f"{where}: metrics version {version}" for version, where in versions.items())
        raise InputError(f"{told}: their columns do not mean the same: `tunnelcd score` scores a run again")
    if not sources:
        raise InputError(f"{', '.join(str(run.path) for run in runs)}: no finished cell in any of them")
    return sources, len(shared)


def _require_one_name(seen: dict[str, str], name: str, cell: Mapping[str, Any], run: RunFolder) -> None:
    """Refuse two worlds or variants that share a file, also where a disk takes upper and lower case as one."""
    case = "{scenario} {seed} {variant}".format(**cell["row"])
    if (other := seen.setdefault(name.casefold(), case)) != case:
        raise InputError(f"{run.path / name}: holds {case}, and another folder has {other} there: rename one")


def _require_same(name: str, first: RunFolder, second: RunFolder, cell: Mapping[str, Any]) -> None:
    """Refuse a cell of which two runs hold different results."""
    other = first.read_cell(first.path / name)
    difference = "one of the files is damaged" if other is None else next(find_differences(other, cell), "")
    digests = [_digest_answer(run.path / _answer_of(name)) for run in (first, second)]
    if not difference and all(digests) and digests[0] != digests[1]:  # one may have rows alone
        difference = "the stored answers"
    if difference:
        case = "{scenario} {seed} {variant}".format(**cell["row"])
        raise InputError(
            f"{case}: {first.path} and {second.path} hold different results ({difference}): remove the cell from one, "
            "or run it again there with --force"
        )


def is_time(column: str) -> bool:
    """Tell whether a column says when, by which code or how fast a row was made."""
    return column.startswith("t_") or column in ("commit", "is_contended")


def find_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> Iterator[str]:
    """Yield what differs between two cells, times apart."""
    if first["key"] != second["key"]:
        yield f"scenario, settings, weights or extras: key {first['key']} and {second['key']}"
    for table in ("row", *ITEM_TABLES, *SURFACE_TABLES):
        rows = [cell.get(table) or [] for cell in (first, second)]
        ones, others = ([each] if isinstance(each, dict) else each for each in rows)
        if len(ones) != len(others):
            yield f"{len(ones)} and {len(others)} rows of {table}"
            continue
        for number, (one, other) in enumerate(zip(ones, others, strict=True)):
            where = "" if table == "row" else f"{table} {number}: "
            names = [name for name in {**one, **other} if not is_time(name)]
            yield from (
                f"{where}{name} = {one.get(name)!r} and {other.get(name)!r}"
                for name in names
                if digest(one.get(name)) != digest(other.get(name))
            )


def _digest_answer(folder: Path) -> str:
    """Return the digest of a stored answer without its seconds; "" where there is none."""
    document, arrays = (folder / name for name in ANSWER_FILES)
    if not document.is_file():
        return ""
    # the key of the cell stands for its settings, which name weights by their place on one machine
    found = read_json(document, "expected an answer written by `tunnelcd run`")
    told = {name: value for name, value in found.items() if name not in ("seconds", "config")}
    stored = read_npz(arrays, lambda types: None) if arrays.is_file() else {}
    content = {name: hashlib.sha256(array.tobytes()).hexdigest() for name, array in stored.items()}
    return digest([told, content, {name: [array.dtype.str, *array.shape] for name, array in stored.items()}])


def _answer_of(cell: str) -> Path:
    """Return the folder of the answer of a cell, below its run folder."""
    return Path("answers", *Path(cell).parts[1:]).with_suffix("")


def _take_cell(source: Path, target: Path, name: Path) -> None:
    """Copy the answer of a cell and then the cell."""
    answer = _answer_of(name.as_posix())
    if (source / answer).is_dir():
        (target / answer).mkdir(parents=True)
        for file in ANSWER_FILES:
            if (source / answer / file).is_file():
                shutil.copyfile(source / answer / file, target / answer / file)
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / name, target / name)


def _take_pairs(runs: Sequence[RunFolder], target: Path, progress: RunProgress) -> None:
    """Link or copy the pairs and maps; of a pair that several runs hold, those of the first."""
    found: dict[str, Path] = {}
    for run in runs:
        for truth in sorted(run.path.glob("pairs/*/*/truth/changes.json")):
            found.setdefault(truth.parents[1].relative_to(run.path).as_posix(), truth.parents[1])
        for path in sorted(run.path.glob("maps/*/*.npz")):
            found.setdefault(path.relative_to(run.path).as_posix(), path)
    for done, (name, path) in enumerate(found.items()):
        progress.stage("sessions", done, len(found))
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            copy_folder(path, target / name, _link_or_copy)
        else:
            _link_or_copy(path, target / name)


def _require_same_pairs(runs: Sequence[RunFolder], progress: RunProgress) -> None:
    """Refuse a pair of which two runs answered different sessions; of removed ones the record tells."""
    holders: dict[str, dict[Path, Path]] = {}
    for run in runs:
        records = {path.with_suffix(""): path for path in list_records(run)}
        pairs = {path.parents[1]: path.parents[1] for path in sorted(run.path.glob("pairs/*/*/truth/changes.json"))}
        for path, place in (records | pairs).items():
            holders.setdefault("/".join(path.parts[-2:]), {})[run.path] = place
    shared = {name: places for name, places in holders.items() if len(places) > 1}
    for done, (name, places) in enumerate(shared.items()):
        progress.stage("pairs compared", done, len(shared))
        digests = {where: _digest_pair(place) for where, place in places.items()}
        (first, digest_there), *others = digests.items()
        for where, found in others:
            if found != digest_there:
                world, seed = name.split("/")
                rows = (run.any_row(world) for run in runs)
                case = f"{next((row['scenario'] for row in rows if row is not None), world)} {seed}"
                raise InputError(
                    f"{case}: {first} and {where} answered different sessions (digest {digest_there} and {found}): "
                    "run it again in one of them with --force"
                )


def _digest_pair(place: Path) -> str | None:
    if place.is_dir():
        return digest_files(place)
    record = read_dropped(place)
    return None if record is None else record.digest


def _take_records(runs: Sequence[RunFolder], target: Path) -> None:
    """Copy the records of removed sessions."""
    for run in runs:
        for path in list_records(run):
            name = path.relative_to(run.path)
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target / name)


def _unite_evaluations(runs: Sequence[RunFolder]) -> dict[str, dict[str, Any]]:
    """Return evaluation.json of each evaluated method with the pairs of all runs; refuse two methods of one name."""
    united: dict[str, dict[str, Any]] = {}
    holders: dict[str, Path] = {}
    for run in runs:
        for path in sorted(run.path.glob("evaluations/*/evaluation.json")):
            found, name = read_json(path, "expected a file of `tunnelcd evaluate`"), path.parent.name
            other = united.setdefault(name, found)
            differing = [key for key in _OF_A_METHOD if other.get(key) != found.get(key)]
            if differing:
                raise InputError(
                    f"{holders[name]} and {run.path} hold answers of different methods or plans under the name {name} "
                    f"({differing[0]}): evaluate one of them under another name"
                )
            holders.setdefault(name, run.path)
            pairs = dict.fromkeys([*_read_pairs(other, path), *_read_pairs(found, path)])
            united[name] = {**other, "pairs": list(pairs), "askers": _unite_askers(other, found)}
    return united


def _read_pairs(evaluation: Mapping[str, Any], path: Path) -> list[tuple[str, int]]:
    """Return scenario and seed of each pair of an evaluation.json."""
    try:
        return _PAIRS.validate_python(evaluation.get("pairs", ()))
    except ValidationError as error:
        raise InputError(f"{path}: damaged: expected pairs of a scenario and a seed: evaluate again there") from error


def _unite_askers(*evaluations: Mapping[str, Any]) -> list[Any]:
    """Return what asked pairs, each once; [] where one of the evaluations does not tell."""
    one, other = (evaluation.get("askers") or [] for evaluation in evaluations)
    are_known = isinstance(one, list) and isinstance(other, list) and one and other
    return [*one, *(each for each in other if each not in one)] if are_known else []


def _take_evaluations(
    runs: Sequence[RunFolder],
    united: Mapping[str, Mapping[str, Any]],
    sources: Mapping[str, RunFolder],
    target: Path,
) -> None:
    """Write evaluation.json, and take the record of each call from the run that gives its cell."""
    for name, document in united.items():
        folder = target / "evaluations" / name
        for run in runs:
            for path in sorted((run.path / "evaluations" / name).glob("*/*.json")):
                place = folder / path.parent.name / path.name
                if sources.get(f"cells/{path.parent.name}/{path.stem}/{name}.json", run) is not run:
                    continue
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, place)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "evaluation.json", document)


def _link_or_copy(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _missing(run: RunFolder, told: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one sentence for the shards that are missing, and one for pairs that are not finished."""
    provenance = run.provenance()
    plan = read_stored_plan(provenance)
    if plan is None:
        mistake = explain_unreadable_plan(provenance)
        return [f"what is missing cannot be told, as the plan cannot be read here: {mistake}"] if mistake else []
    planned = list_planned_cases(plan)
    done = {tuple(cell["row"][name] for name in ("scenario", "seed", "variant")) for cell in run.each_cell()}
    lacking = {case[:2] for case in planned if case not in done}
    if not lacking:
        return []
    shards = [stored_shard(each) for each in told]
    counts = {shard.n for shard in shards if shard is not None}
    if None not in shards and len(counts) == 1:
        (n,) = counts
        absent = sorted({*range(1, n + 1)} - {shard.index for shard in shards if shard is not None})
        named = [f"shard {index}/{n} is missing" for index in absent]
    else:
        named = []
    order = number_pairs((world.label, seed) for world in plan.worlds for seed in plan.seeds[: world.n_seeds])
    first = min(lacking, key=lambda pair: order.get(pair, 0))
    pairs = f"{len(lacking)} of {len(order)} planned pairs are not finished, the first is {first[0]} {first[1]}"
    return [*named, f"{pairs}: run them into the new folder, or merge the rest"]
