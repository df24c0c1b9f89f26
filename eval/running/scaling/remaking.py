"""Makes pairs again whose sessions were removed: from the drawn scenario and the seed, to the same bytes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, validate
from eval.core.output import remove
from eval.core.terminal.progress import RunProgress, Silent
from eval.running.pair_run import TOOLS, Tools, pair_lock_of, write_maps
from eval.running.runfolder import RunFolder
from eval.running.scaling.keeping import Dropped, dropped_file, read_dropped, remove_pair, require_same_bytes
from eval.running.stages.pair_stages import PairStages
from eval.truth.adapters import pipeline_input
from scenarios.grafted import GraftScenario
from scenarios.references import file_digests
from scenarios.schema import Scenario


def remake_pair(
    run: RunFolder, world: str, seed: int, progress: RunProgress | None = None, tools: Tools | None = None
) -> Path:
    """Make the sessions of a pair again and put them where they were; a pair that is there stays.

    Args:
        run: The run.
        world: Label of the pair's world, or the name of its folder.
        seed: Its seed.
        progress: Receives the progress.
        tools: What simulates.

    Returns:
        The folder of the pair.

    Raises:
        InputError: Nothing says how to make it, a file of its scenario has changed, or other bytes come out.
        ScenarioError: The scenario cannot be built any more.
    """
    path, progress = run.pair(world, seed), progress or Silent()
    with pair_lock_of(run, world, seed):
        if path.is_dir():
            return path
        source = dropped_file(run, world, seed)
        record = read_dropped(source)
        if record is None:
            raise InputError(f"{path}: no such pair, and {source} is missing, which would tell how to make it again")
        progress.note(f"{record.world} {seed}: made again, {record.n_bytes / 1e6:.0f} MB")
        unchecked = path.with_name(f".{seed}.again")
        try:
            remove(unchecked)
            unchecked.parent.mkdir(parents=True, exist_ok=True)
            (tools or TOOLS).simulate(_read_scenario(source, record), record.seed, unchecked, progress.stage)
            require_same_bytes(record, unchecked)
            unchecked.rename(path)
        finally:
            remove(unchecked)
        return path


@dataclass(frozen=True, slots=True)
class RemakingFolder(RunFolder):
    """A run folder whose pairs and maps are made again when somebody asks for their place.

    Attributes:
        progress: Receives the progress.
        tools: What simulates, else the simulator.
        made: What was made, for the one who cleans up.
    """

    progress: RunProgress = field(default_factory=Silent)
    tools: Tools | None = None
    made: list[Path] = field(default_factory=list)

    def pair(self, scenario: str, seed: int) -> Path:
        """Return the folder of a pair, whose sessions are there unless nothing says how to make them."""
        run = RunFolder(self.path)
        path = run.pair(scenario, seed)
        if not path.is_dir() and dropped_file(run, scenario, seed).is_file():
            self.made.append(remake_pair(run, scenario, seed, self.progress, self.tools))
        return path

    def maps(self, scenario: str, seed: int) -> Path:
        """Return the file of the thinned maps of a pair, made from its sessions where it was removed with them."""
        run = RunFolder(self.path)
        path = run.maps(scenario, seed)
        if not path.exists() and dropped_file(run, scenario, seed).is_file():
            pair = self.pair(scenario, seed)
            sessions = pipeline_input(pair, "before"), pipeline_input(pair, "after")
            write_maps(path, PairStages(*sessions, self.progress.stage))
            self.made.append(path)
        return path


@contextmanager
def remade_when_asked(
    run: RunFolder, progress: RunProgress | None = None, *, is_wanted: bool = True, tools: Tools | None = None
) -> Iterator[RunFolder]:
    """Yield the folder with pairs and maps that are made again when they are asked for, and removed afterwards."""
    folder = RemakingFolder(run.path, progress or Silent(), tools) if is_wanted else run
    try:
        yield folder
    finally:
        for path in folder.made if isinstance(folder, RemakingFolder) else ():
            remove_pair(path) if path.is_dir() else remove(path)


@contextmanager
def remade_below(
    paths: Sequence[Path], progress: RunProgress | None = None, tools: Tools | None = None
) -> Iterator[None]:
    """Make the pairs of run folders to which some paths lead, where they were removed; for the time of the block."""
    with ExitStack() as stack:
        for path in paths:
            for pair in (path, *path.parents) if not path.exists() else ():
                run = RunFolder(pair.parents[2]) if len(pair.parents) > 2 else RunFolder(pair)
                is_pair = pair.parent.parent.name == "pairs" and re.fullmatch(r"\d{1,15}", pair.name, re.ASCII)
                if is_pair and dropped_file(run, pair.parent.name, int(pair.name)).is_file():
                    folder = stack.enter_context(remade_when_asked(run, progress, tools=tools))
                    folder.pair(pair.parent.name, int(pair.name))
                    break
        yield


def _read_scenario(source: Path, record: Dropped) -> Scenario:
    model = GraftScenario if "recording" in record.scenario else Scenario
    scenario = validate(model, Document(str(source), dict(record.scenario)))
    found = file_digests(scenario)
    if changed := [name for name in found if record.files.get(name) != found[name]]:
        raise InputError(
            f"{changed[0]}: has changed since {record.world} {record.seed} was made of it: restore the file"
        )
    return scenario
