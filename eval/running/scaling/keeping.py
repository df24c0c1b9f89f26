"""What stays of a pair after its last cell: its sessions, its answers, or its rows alone.

RUN/dropped/<world>/<seed>.json takes the place of sessions that were removed. It holds what makes the pair again, the
scenario as drawn and the seed, and the digest of all of its files (`eval.running.scaling.remaking`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json
from cdpipe.core.yamlfile import Document, Settings, validate
from eval.core.output import remove
from eval.core.provenance import digest, digest_file
from eval.running.cell_file import NO_KEY
from eval.running.runfolder import NEW_TABLES, RunFolder, write_json
from eval.running.stages.stage_cache import files_digest
from scenarios.references import without_paths
from sim.session.truth import read_pair_truth

Keep = Literal["answers", "sessions", "nothing"]
RECORDS = "dropped"
# files that scoring and `tunnelcd describe` leave beside the sessions
_DERIVED = {"scoring_points.npz", "descriptors"}
_EXPECTED = "the pair cannot be made again: run its plan again with --force"


class Dropped(Settings):
    """A pair whose sessions were removed.

    Attributes:
        world: Label of its world.
        seed: Its seed.
        scenario: The scenario as drawn.
        files: Digests of the files that the scenario names.
        digest: Digest of all files that the simulator wrote, truth included.
        n_bytes: Their size.
    """

    format: Literal["tunnelcd-dropped"] = "tunnelcd-dropped"
    format_version: Literal[1] = 1
    world: str
    seed: Annotated[int, Field(ge=0)]
    scenario: Mapping[str, Any]
    files: Mapping[str, str]
    digest: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    n_bytes: Annotated[int, Field(ge=0)]


def drop_pair(run: RunFolder, world: str, seed: int, keep: Keep) -> None:
    """Remove the sessions, maps and stages of a pair, and its answers where nothing is kept. The caller holds its lock.

    The record is written first and the pair loses its name before its files: a crash leaves all of it or none.
    Answers of other programs stay, because nothing makes them again.

    Raises:
        InputError: The truth of the pair is damaged.
    """
    path = run.pair(world, seed)
    if path.is_dir():
        truth = read_pair_truth(path)
        told = {"scenario": dict(truth.scenario), "files": dict(truth.files), "digest": digest_files(path)}
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        record = Dropped(world=world, seed=truth.seed, n_bytes=size, **told)
        write_json(dropped_file(run, world, seed), record.model_dump())
    if keep == "nothing":
        _remove_answers(run, world, seed)
    remove_pair(path)
    remove(run.maps(world, seed))
    remove(run.stages(world, seed))


def remove_pair(path: Path) -> None:
    """Remove the folder of a pair, which loses its name first."""
    hidden = path.with_name(f".{path.name}.removed")
    remove(hidden)
    if path.is_dir():
        path.rename(hidden)
        remove(hidden)


def remove_leftovers(run: RunFolder) -> None:
    """Remove what an interrupted removal, making again, or writing of tables left."""
    for path in (*run.path.glob("pairs/*/.*.removed"), *run.path.glob("pairs/*/.*.again"), run.path / NEW_TABLES):
        remove(path)


def digest_files(pair: Path) -> str:
    """Return the digest of all files of a pair that the simulator writes.

    Where its scenario names files, those stand there by their digests: paths depend on the working folder.
    """
    own = _list_files(pair)
    named = read_pair_truth(pair).files if (pair / "truth").is_dir() else {}
    if not named:
        return files_digest(pair, own)
    return digest({path.relative_to(pair).as_posix(): _digest_without_paths(path, named) for path in own})


def _list_files(pair: Path) -> list[Path]:
    files = [path for path in pair.rglob("*") if path.is_file()]
    return [path for path in files if _DERIVED.isdisjoint(path.relative_to(pair).parts)]


def _digest_without_paths(file: Path, named: Mapping[str, str]) -> str:
    if file.name not in ("changes.json", "session.json"):
        return digest_file(file)
    document = read_json(file, _EXPECTED)
    if isinstance(document.get("scenario"), dict):
        document |= {"scenario": without_paths(document["scenario"], named), "files": sorted(named.values())}
    told = document.get("provenance")
    if isinstance(told, dict) and (profile := told.get("sensor_profile")) in named:
        document["provenance"] = {**told, "sensor_profile": named[str(profile)]}
    return digest(document)


def dropped_file(run: RunFolder, world: str, seed: int) -> Path:
    """Return where the record of a pair lies whose sessions were removed."""
    return run.path / RECORDS / run.pair(world, seed).parent.name / f"{seed}.json"


def read_dropped(path: Path) -> Dropped | None:
    """Read the record of a pair; None where there is none.

    Raises:
        InputError: It is damaged.
    """
    return validate(Dropped, Document(str(path), read_json(path, _EXPECTED))) if path.is_file() else None


def require_same_bytes(record: Dropped, pair: Path) -> None:
    """Refuse a pair that is not, to the byte, the one whose sessions were removed.

    Raises:
        InputError: It is another one.
    """
    found = digest_files(pair)
    # older records are of files with their paths
    if record.digest not in (found, files_digest(pair, _list_files(pair))):
        raise InputError(
            f"{record.world} {record.seed}: made again, and its files differ from those that its answers are of "
            f"(digest {found}, not {record.digest}): use the versions that provenance.json names, or run the plan "
            "again with --force"
        )


def list_records(run: RunFolder) -> list[Path]:
    """Return the records of all pairs whose sessions were removed, also where these were made again."""
    return sorted(run.path.glob(f"{RECORDS}/*/*.json"))


def list_dropped(run: RunFolder) -> list[Path]:
    """Return the records of the pairs whose sessions are not in the folder."""
    return [path for path in list_records(run) if not (run.path / "pairs" / path.parent.name / path.stem).is_dir()]


def is_dropped(
    run: RunFolder, world: str, seed: int, scenario: Mapping[str, Any], files: Mapping[str, str]
) -> bool | None:
    """Tell whether the removed sessions of a pair were made from this scenario and these files; None without them."""
    record = None if run.pair(world, seed).exists() else read_dropped(dropped_file(run, world, seed))
    if record is None:
        return None
    return digest(without_paths(record.scenario, record.files)) == digest(without_paths(scenario, files))


def _remove_answers(run: RunFolder, world: str, seed: int) -> None:
    cells = run.path / "cells" / run.pair(world, seed).parent.name / str(seed)
    for path in cells.glob("*.json"):
        cell = run.read_cell(path)
        if cell is not None and cell["key"] != NO_KEY:
            remove(run.path / "answers" / path.parts[-3] / path.parts[-2] / path.stem)
