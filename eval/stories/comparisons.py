"""Compares session 1 of a story with every later session. What is finished is kept.

OUT/story_report.json                 story, method and settings that the folder belongs to
OUT/pairs/01-03/                      sessions 1 and 3 as a pair with truth (hard links to the story's files)
OUT/answers/01-03/                    the answer, as `tunnelcd detect --surface` writes it
OUT/displacement.csv props.csv index.html
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cdpipe
from cdpipe.core.errors import InputError, MergeFailedError
from cdpipe.core.files import read_bytes, read_json
from cdpipe.descriptors import list_checkpoints
from cdpipe.io.answer import Answer, read_answer, write_failure
from cdpipe.io.session import is_session
from cdpipe.model.config import WEIGHTS_FILES, PipelineConfig, Site
from eval.core.output import make_writable, new_folder, only_writer, require_no_links
from eval.core.provenance import digest, versions
from eval.core.terminal.progress import RunProgress
from eval.running.runfolder import write_json
from eval.scoring.scoring import CaseScore, score_stored
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from sim.story import PairMaker, is_story, read_story

_NAME = re.compile(r"session-(\d\d)")
_MARK = "story_report.json"


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Session 1 against a later session.

    Attributes:
        number: Number of the later session.
        answer: What the method answered; its status says whether the merge was refused.
        truth: The truth of the pair; None where there is none, or it was not asked for.
        score: The answer's scores against it.
    """

    number: int
    answer: Answer
    truth: GroundTruth | None = None
    score: CaseScore | None = None


@dataclass(frozen=True, slots=True)
class Method:
    """A method with its settings.

    Attributes:
        preset: Name of the preset.
        site: Section of the preset.
        settings: What is set over it.
    """

    preset: str
    site: Site
    settings: tuple[str, ...]

    @property
    def config(self) -> PipelineConfig:
        """The effective settings."""
        return cdpipe.load_config(self.preset, self.settings, self.site)


def list_sessions(story: Path) -> dict[int, Path]:
    """Return the sessions of a story by their numbers, in order.

    Raises:
        InputError: There is no session 1, or no later one; or a simulated story lacks a session.
    """
    found = {}
    for path in sorted(story.iterdir()) if story.is_dir() else ():
        match = _NAME.fullmatch(path.name)
        if match and is_session(path):
            found[int(match[1])] = path
    if 1 not in found or len(found) < 2:
        raise InputError(
            f"{story}: expected session-01 and later sessions, as `tunnelcd simulate --sessions 3 ...` writes them; "
            "folders with a session.json of recordings may stand there under such names, too"
        )
    if is_story(story) and (missing := set(range(1, len(read_story(story).sessions) + 1)) - set(found)):
        raise InputError(f"{story}/session-{min(missing):02d}: missing, or damaged: simulate the story again")
    return found


def run_comparisons(
    story: Path, out: Path, method: Method, progress: RunProgress, *, with_truth: bool = True
) -> list[Comparison]:
    """Compare session 1 of a story with every later session; comparisons in `out` that are finished are kept.

    Args:
        story: Folder of a story, or of recorded sessions under the names of one.
        out: New, empty, or of an earlier call with the same story and method.
        method: What answers.
        progress: Receives the comparisons and their stages.
        with_truth: Whether pairs with truth are made, where the folder is that of a simulated story.

    Raises:
        InputError: The folder is no story; `out` is of another story or other settings, cannot be written, or another
            process writes there.
    """
    sessions = list_sessions(story)
    has_truth = with_truth and is_story(story)
    maker = PairMaker(story) if has_truth else None
    mark = _describe(story, sessions, method)
    make_writable(out)
    with only_writer(out, "tunnelcd story"):
        _claim(out, story, mark, method)
        return _compare(sessions, out, method, progress, maker)


def _compare(
    sessions: dict[int, Path], out: Path, method: Method, progress: RunProgress, maker: PairMaker | None
) -> list[Comparison]:
    """Compare session 1 with every later one, as `run_comparisons` does, with truth where there is who makes it."""
    done = []
    later = [number for number in sessions if number > 1]
    for count, number in enumerate(later):
        progress.cells(f"session 1 against {number}", count, len(later))
        pair, folder = out / "pairs" / f"01-{number:02d}", out / "answers" / f"01-{number:02d}"
        if maker is not None and not pair.exists():
            with new_folder(pair) as partial:
                maker.make(1, number, partial, progress.stage)
        if not folder.exists():
            with new_folder(folder) as partial:
                _answer(sessions[1], sessions[number], partial, method, progress)
        answer = read_answer(folder)
        truth = None if maker is None else load_ground_truth(pair)
        done.append(Comparison(number, answer, truth, None if truth is None else score_stored(truth, folder)))
    progress.cells("done", len(later), len(later))
    return done


def _answer(before: Path, after: Path, folder: Path, method: Method, progress: RunProgress) -> None:
    try:
        hooks = cdpipe.Hooks(progress.stage)
        report = cdpipe.detect(before, after, method.preset, method.settings, method.site, hooks)
    except MergeFailedError as error:
        config = method.config.model_dump(mode="json")
        write_failure(folder, method.preset, "merge_refused", str(error), error.evidence, config, None, error.seconds)
        return
    cdpipe.save_report(report, folder, method.preset)


def _describe(story: Path, sessions: dict[int, Path], method: Method) -> dict[str, Any]:
    """Return what must be the same for a finished comparison to be kept."""
    return {
        "tool": "tunnelcd story",
        "story": _digest_story(story, sessions),
        "preset": method.preset,
        "config": digest(method.config.model_dump(mode="json", exclude=WEIGHTS_FILES)),
        # the digests name the weights, wherever their files lie
        "checkpoints": list_checkpoints(method.config),
    }


def _claim(out: Path, story: Path, wanted: dict[str, Any], method: Method) -> None:
    """Mark an empty folder as that of this story and method, or check that it is.

    Raises:
        InputError: It is of another one, holds something else, or cannot be written.
    """
    mark = out / _MARK
    if mark.is_file():
        require_no_links(out)
        found = read_json(mark, "written by `tunnelcd story`")
        if {name: found.get(name) for name in wanted} != wanted:
            differing = "story" if found.get("story") != wanted["story"] else "method, settings or weights"
            raise InputError(f"{out}: is the report of another {differing} than {story}: name a new folder")
        return
    if any(out.iterdir()):
        raise InputError(f"{out}: is not empty, and no report of a story: name a new or empty folder")
    write_json(mark, wanted | {"settings": list(method.settings), "site": method.site, "versions": versions()})


def _digest_story(story: Path, sessions: dict[int, Path]) -> dict[str, str]:
    """Return a digest of each session by its number, and of what the truth of a simulated story follows from.

    story.json holds digests of all files of its sessions, so that these are not read. Poses and description alone can
    be equal in two stories, as where one has a sensor without dropouts.
    """
    told = read_story(story) if is_story(story) else None
    known = {} if told is None else told.digests
    found = {
        f"{number:02d}": digest(known[path.name]) if path.name in known else _digest_session(path)
        for number, path in sessions.items()
    }
    if told is not None:
        found["truth"] = digest(told.model_dump(mode="json", exclude={"digests", "versions"}))
    return found


def _digest_session(session: Path) -> str:
    """Return a digest of a session's description, poses and scans."""
    found = hashlib.sha256()
    for path in (session / "session.json", session / "odometry.npz", *sorted((session / "chunks").glob("*.npz"))):
        found.update(hashlib.sha256(read_bytes(path)).digest())
    return found.hexdigest()[:16]


def refused_sessions(comparisons: Sequence[Comparison]) -> list[str]:
    """Return a line for each comparison without an answer."""
    return [f"Session {each.number}: {each.answer.error}" for each in comparisons if each.answer.report is None]
