"""Makes a release: simulates its pairs, sets their truth apart, and writes digests, data card, metadata and the file.

    DIR/README.md, croissant.json, SHA256SUMS
    DIR/sessions/<opaque name>/before, after              what a method may see: scans, odometry, sensor
    DIR/truth/<opaque name>/before, after, truth          all else of the pair; both folders together are the pair
    DIR/truth/pairs.csv                                   one row per pair: its name, family, seed and counts

A file is made of such a folder, FILE.parts, which is removed when the file is whole. A pair whose two folders are there
is finished and kept: its name is a digest of all that it is made of except code.
"""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import TypeAdapter

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.whole_file import partial_of, whole_file
from eval.core.cluster import HERE, Where, connected, require_usable
from eval.core.output import made_parents, make_writable, only_writer, remove, removed_if_empty, require_no_links
from eval.core.terminal.progress import RunProgress, Silent
from eval.release.archive import SESSIONS, SUMS, TRUTH, list_files, pack, read_sums, write_sums
from eval.release.card import write_release_card
from eval.release.content import Release, ReleasePair
from eval.release.croissant import FILE
from eval.running.export import copy_pair
from scenarios.schema import Scenario
from sim.session.simulate import simulate_pair

_SCRATCH = ".making-"
_LEFT = re.compile(r"\.making-[a-z0-9_]{8}")  # as `tempfile` goes on
_OWN = {"README.md", FILE, SUMS, SESSIONS, TRUTH}
_Task = tuple[str, str, int, Scenario]
_TASK: TypeAdapter[_Task] = TypeAdapter(_Task)


@dataclass(frozen=True, slots=True)
class ReleaseOutcome:
    """How the making of a release ended.

    Attributes:
        n_made: Pairs simulated now.
        n_kept: Pairs kept from earlier.
        n_left: Pairs left by a limit; the release is not whole then.
        n_bytes: Size of the file, or of all files of the folder; 0 while pairs are left.
        seconds: Wall clock.
    """

    n_made: int
    n_kept: int
    n_left: int
    n_bytes: int
    seconds: float


def make_release(
    release: Release,
    out: Path,
    where: Where = HERE,
    limit: int | None = None,
    progress: RunProgress | None = None,
) -> ReleaseOutcome:
    """Make the pairs of a release that are missing, then its file or folder.

    Args:
        release: The release.
        out: A file that ends in .zip, which must not exist; else a folder: new, empty, or of an earlier run.
        where: This process, or worker processes of this machine.
        limit: Simulate at most this many pairs.
        progress: Receives the number of finished pairs.

    Raises:
        InputError: `out` cannot be used, another process makes it, or a scheduler of other machines is named.
        ScenarioError: A pair cannot be built.
    """
    progress, start = progress or Silent(), time.perf_counter()
    if where.scheduler is not None:
        raise InputError("--scheduler: a release is made on this machine: give --workers instead")
    require_usable(where)
    is_file = out.suffix == ".zip"
    if is_file and (out.exists() or out.is_symlink()):
        raise InputError(f"{out}: exists already: name a new file, or remove it")
    folder = out.with_name(f"{out.name}.parts") if is_file else out
    if is_file and folder.is_symlink():
        raise InputError(f"{folder}: is a link, and this folder is removed in the end: remove the link")
    with made_parents(out), removed_if_empty(folder), _held(folder):
        _take_folder(folder, release)
        missing = [pair for pair in release.pairs if not _is_finished(folder, pair)]
        todo = missing[:limit]
        _make_pairs(folder, todo, where, progress)
        counts = len(todo), len(release.pairs) - len(missing), len(missing) - len(todo)
        if counts[2]:
            return ReleaseOutcome(*counts, 0, time.perf_counter() - start)
        n_bytes = _finish(release, folder, out if is_file else None, progress)
        return ReleaseOutcome(*counts, n_bytes, time.perf_counter() - start)


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Make a folder unless it exists, and hold it against other processes that make a release there."""
    make_writable(folder)
    with only_writer(folder, "tunnelcd dataset --release"):
        yield


def make_pair(folder: Path, name: str, seed: int, scenario: Scenario) -> None:
    """Simulate one pair, and write its sessions and its truth apart into the folder of a release.

    Raises:
        InputError: It cannot be written.
        ScenarioError: It cannot be built.
    """
    with TemporaryDirectory(prefix=_SCRATCH, dir=folder) as scratch:
        whole, sessions = Path(scratch, "pair"), Path(scratch, SESSIONS)
        simulate_pair(scenario, seed, whole)
        sessions.mkdir()
        copy_pair(whole, sessions)
        _keep_truth(whole, sessions)
        for source, kind in ((whole, TRUTH), (sessions, SESSIONS)):
            target = folder / kind / name
            remove(target)
            target.parent.mkdir(exist_ok=True)
            source.rename(target)


def make_pair_of_task(document: str) -> str:
    """Make a pair on a worker; returns "", or the reason why it cannot be built."""
    folder, name, seed, scenario = _TASK.validate_json(document)
    try:
        make_pair(Path(folder), name, seed, scenario)
    except ScenarioError as error:
        return str(error)
    return ""


def _keep_truth(whole: Path, sessions: Path) -> None:
    """Remove from a pair the files that its blind copy holds too, byte by byte."""
    for name in list_files(sessions):
        twin = whole / name
        if twin.read_bytes() == (sessions / name).read_bytes():
            twin.unlink()
    for each in sorted(whole.rglob("*"), reverse=True):
        if each.is_dir() and not any(each.iterdir()):
            each.rmdir()


def _take_folder(folder: Path, release: Release) -> None:
    """Check that a folder is of this release, and remove what a killed run left."""
    require_no_links(folder)
    for left in folder.glob(f"{_SCRATCH}*"):
        if _LEFT.fullmatch(left.name):
            shutil.rmtree(left, ignore_errors=True)
    for name in _OWN:
        remove(partial_of(folder / name))
    here = {path.name for path in folder.iterdir()} - _OWN
    names = {pair.name for pair in release.pairs}
    for kind in (SESSIONS, TRUTH):
        here |= {f"{kind}/{path.name}" for path in (folder / kind).glob("*") if path.name not in names | {"pairs.csv"}}
    if here:
        raise InputError(
            f"{folder}: holds {min(here)}, which is not of this release and version: name a new place, or remove it"
        )


def _is_finished(folder: Path, pair: ReleasePair) -> bool:
    return all((folder / kind / pair.name).is_dir() for kind in (SESSIONS, TRUTH))


def _make_pairs(folder: Path, pairs: Sequence[ReleasePair], where: Where, progress: RunProgress) -> None:
    for done, pair in enumerate(_made(folder, pairs, where, progress), start=1):
        progress.cells(f"{pair.family} {pair.seed}", done, len(pairs))


def _made(folder: Path, pairs: Sequence[ReleasePair], where: Where, progress: RunProgress) -> Iterator[ReleasePair]:
    """Yield each pair when it is made."""
    if pairs:
        progress.cells("the first pair", 0, len(pairs))
    if where == HERE or not pairs:
        for pair in pairs:
            make_pair(folder, pair.name, pair.seed, pair.scenario)
            yield pair
        return
    from distributed import as_completed  # noqa: PLC0415 - an extra, and slow to import

    with connected(where, len(pairs)) as client:
        home = str(folder.absolute())
        documents = [_TASK.dump_json((home, pair.name, pair.seed, pair.scenario)).decode() for pair in pairs]
        pair_of = {client.submit(make_pair_of_task, document, pure=False): pair
                   for document, pair in zip(documents, pairs, strict=True)}  # fmt: skip
        for future in as_completed(list(pair_of)):
            if reason := future.result():
                raise ScenarioError(reason)
            yield pair_of[future]


def _finish(release: Release, folder: Path, file: Path | None, progress: RunProgress) -> int:
    """Write what describes the pairs, and the file; return its size, or that of the folder."""
    write_release_card(release, folder)
    write_sums(folder, progress)
    if file is None:
        return sum((folder / name).stat().st_size for name in [*read_sums(folder), SUMS])
    with whole_file(file) as partial:
        pack(folder, partial, progress)
    shutil.rmtree(folder)
    return file.stat().st_size
