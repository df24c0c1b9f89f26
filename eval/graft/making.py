"""Pairs of a scenario: simulated, or grafted into the recordings that the scenario names."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path

from cdpipe.core.errors import InputError, MergeFailedError, ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.io.foreign import HowToRead, guess_format, share_topics
from cdpipe.io.foreign.sniff import OUSTER
from cdpipe.io.known_merge import read_known_merge
from cdpipe.io.readers import RecordedScans, import_ouster, open_session
from cdpipe.io.session import ScanChunk, Session, is_session, read_session
from cdpipe.model.config import load_config
from cdpipe.pipeline import Hooks, detect_merge, map_pair
from eval.core.output import new_folder
from eval.graft.clouds import as_session
from scenarios.grafted import GraftScenario, Recording
from scenarios.references import file_digests
from scenarios.schema import Scenario, SessionPlan
from sim.graft import Recorded, graft_in_memory, graft_pair
from sim.session.simulate import HeldPair, simulate_pair, write_pair
from sim.story.afters import simulate_afters


def make_pair(scenario: Scenario, seed: int, out: Path, on_progress: Progress = report_nothing) -> None:
    """Write the pair of a scenario into a folder that does not exist or is empty: `before`, `after` and `truth`.

    Raises:
        InputError: As `simulate_pair`; or a recording cannot be read or split.
        ScenarioError: The world contradicts itself; or a prop finds no place, or the recordings cannot be merged.
    """
    if not isinstance(scenario, GraftScenario):
        simulate_pair(scenario, seed, out, on_progress)
        return
    files = _digest_files(scenario)
    with new_folder(out) as partial:
        _graft(scenario, seed, files, partial, on_progress)


def fill_pair(scenario: Scenario, seed: int, folder: Path, on_progress: Progress = report_nothing) -> None:
    """Write the pair of a scenario into an empty folder that the caller holds.

    Raises:
        InputError, ScenarioError: As `make_pair`.
    """
    if isinstance(scenario, GraftScenario):
        _graft(scenario, seed, _digest_files(scenario), folder, on_progress)
    else:
        write_pair(scenario, seed, folder, on_progress)


def _digest_files(scenario: GraftScenario) -> dict[str, str]:
    """Return the digests of the files of a scenario; refuse a recording that is named twice."""
    files = file_digests(scenario)
    sessions = [files[name] for name in scenario.recording.sessions]
    if len(set(sessions)) < len(sessions):
        raise InputError(f"{' and '.join(scenario.recording.sessions)}: one and the same recording: name it once")
    return files


def _graft(scenario: GraftScenario, seed: int, files: dict[str, str], folder: Path, on_progress: Progress) -> None:
    with open_recorded(scenario.recording, on_progress) as recorded:
        graft_pair(scenario, seed, recorded, files, folder, on_progress)


def make_afters(scenario: Scenario, plans: Sequence[SessionPlan], seed: int) -> Iterator[HeldPair]:
    """Yield the pair of a scenario in memory, and one for each further after session, as `simulate_afters` does.

    Raises:
        InputError: As `make_pair`.
        ScenarioError: As `make_pair`; or a recording is asked for further after sessions.
    """
    if not isinstance(scenario, GraftScenario):
        yield from simulate_afters(scenario, plans, seed)
        return
    if plans:
        raise ScenarioError(f"{scenario.family}: its sessions are recorded: leave out `--afters`")
    with open_recorded(scenario.recording) as recorded:
        yield graft_in_memory(scenario, seed, recorded, file_digests(scenario))


@contextmanager
def open_recorded(recording: Recording, on_progress: Progress = report_nothing) -> Iterator[Recorded]:
    """Open the recordings of a pair, and find their merge where it is not given.

    Raises:
        InputError: One cannot be read, or the file of the merge holds none.
        ScenarioError: No merge is found.
    """
    paths = [Path(name) for name in recording.sessions]
    hows = share_topics(paths, [_how(recording, number) for number in range(len(paths))])
    with tempfile.TemporaryDirectory(prefix="tunnelcd-graft-") as folder:
        sessions = tuple(
            _open(path, how, Path(folder) / str(number), on_progress)
            for number, (path, how) in enumerate(zip(paths, hows, strict=True))
        )
        if len(sessions) == 1:
            yield Recorded(sessions)
        elif recording.before_T_after is not None:
            origins_m = [how.subtracted_m(path) for how, path in zip(hows, paths, strict=True)]
            yield Recorded(sessions, read_known_merge(Path(recording.before_T_after), origins_m), "given")
        else:
            yield Recorded(sessions, _find_merge(sessions, on_progress), "tunnelcd")


def _how(recording: Recording, number: int) -> HowToRead:
    """Return how to read a recording; options are for the others where it is a session and one of them is none."""
    are_sessions = [is_session(Path(name)) for name in recording.sessions]
    if are_sessions[number] and not all(are_sessions) and not recording.trajectories:
        return HowToRead()
    trajectory = Path(recording.trajectories[number]) if recording.trajectories else None
    metadata = Path(recording.metadata[number]) if recording.metadata else None
    told = recording.format, recording.topics, trajectory, recording.odometry, metadata, recording.deskew
    return HowToRead(*told, recording.origin_m)


def _open(path: Path, how: HowToRead, folder: Path, on_progress: Progress) -> Session:
    """Open a recording as a session; an OSF or PCAP is written into a folder first."""
    name = guess_format(path, how.format)
    if name == "session":
        open_session(path, how)  # which refuses options that a session has no use for
        return read_session(path)
    if name not in OUSTER:
        source = open_session(path, how, on_progress)
        if getattr(source, "is_whole_map", False):
            raise InputError(f"{path}: a map without its scans has no rays to cast along: name the scans instead")
        return as_session(source)
    folder.mkdir()
    import_ouster(path, folder / path.name, how, on_progress)
    stored = read_session(folder / path.name)
    told = {field.name: getattr(stored, field.name) for field in fields(stored)}
    return _Imported(**told | {"path": path}, stored=stored)


@dataclass(frozen=True, slots=True, eq=False)
class _Imported(Session):
    """A session that was imported into a temporary folder; `path` is the recording's file, which messages name."""

    stored: Session

    def chunk(self, index: int) -> ScanChunk:
        """Return one chunk."""
        return self.stored.chunk(index)


def _find_merge(sessions: tuple[Session, ...], on_progress: Progress) -> Float64Array:
    """Return `before_T_after` (4, 4) as preset `tunnelcd` finds it.

    Raises:
        ScenarioError: It is refused.
    """
    config, hooks = load_config("tunnelcd"), Hooks(on_progress)
    sources = [RecordedScans(session) for session in sessions]
    try:
        report = detect_merge(*map_pair(sources, config, hooks).value, config, hooks)
    except MergeFailedError as error:
        names = " and ".join(str(session.path) for session in sessions)
        told = "give their merge: `before_T_after` of the recording, or --before-T-after FILE"
        raise ScenarioError(f"{names}: {error}: {told}") from error
    return report.before_T_after
