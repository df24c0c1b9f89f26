"""Copies the sessions of a run for other programs: blind by default, without truth and under opaque names.

    DIR/<opaque name>/before, after                    blind: what a recorded session would hold, and nothing else
    DIR/<world>/<seed>/before, after, truth            with truth: the pairs as they are
    RUN/blind.json                                     salt, and the scenario and seed of each opaque name

A blind session is written anew, never linked: a hard link shares its times with the run, a symbolic link names the run,
and a program that writes into either one changes the run. All times of a blind copy are the same, and pairs are
written in the order of their opaque names.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes, read_json
from cdpipe.core.yamlfile import Document, Settings, validate
from cdpipe.io.session import SessionWriter, read_session
from eval.core.output import copy_folder, make_writable, new_folder
from eval.core.terminal.progress import RunProgress, Silent
from eval.running.rescoring import foreign_identity
from eval.running.runfolder import RunFolder, write_json
from eval.running.scaling.keeping import list_dropped
from sim.session.truth import SESSIONS

TIME_S = 315_532_800
"""Time of every blind file: the start of 1980, the earliest time that a zip file can hold; seconds since 1970."""
_CHANGES = Path("truth") / "changes.json"
_EXPECTED = "restore the file; a new one gives every pair another name"


class _Names(Settings):
    """RUN/blind.json.

    Attributes:
        salt: 32 random bytes, hexadecimal.
        pairs: Scenario and seed by opaque name, for people.
    """

    format: Literal["tunnelcd-blind"] = "tunnelcd-blind"
    format_version: Literal[1] = 1
    salt: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    pairs: Mapping[str, Mapping[str, Any]] = Field(default_factory=dict)


def export_blind(run: RunFolder, out: Path, progress: RunProgress | None = None) -> int:
    """Write the sessions of each pair of a run without truth, under opaque names. Pairs that are there are kept.

    Returns:
        How many pairs were written now.

    Raises:
        InputError: The run has no pairs, `out` holds something else, lies in the run or cannot be written, or a session
            is damaged.
    """
    pairs = list_pairs(run)
    salt = _stored_salt(run) or _draw_salt()
    names = {_opaque_name(salt, pair): pair for pair in pairs}
    _require_own(run, out, set(names))
    told = {name: foreign_identity(run, pair.parent.name, pair.name, "") for name, pair in names.items()}
    whose = {name: {"scenario": of["scenario"], "seed": of["seed"]} for name, of in sorted(told.items())}
    write_json(run.path / "blind.json", _Names(salt=salt, pairs=whose).model_dump())
    return _export(out, names, copy_pair, progress or Silent())


def export_with_truth(run: RunFolder, out: Path, progress: RunProgress | None = None) -> int:
    """Copy each pair of a run as it is, with its truth and under its name. Pairs that are there are kept.

    Returns:
        How many pairs were written now.

    Raises:
        InputError: As `export_blind`; or `out` holds an earlier simulation of a pair.
    """
    names = {f"{pair.parent.name}/{pair.name}": pair for pair in list_pairs(run)}
    _require_own(run, out, {pair.parent.name for pair in names.values()})
    for name, pair in names.items():
        there = out / name / _CHANGES
        if there.is_file() and read_bytes(there) != read_bytes(pair / _CHANGES):
            raise InputError(f"{out / name}: an earlier simulation of this pair: name a new folder")
    return _export(out, names, copy_folder, progress or Silent())


def list_pairs(run: RunFolder) -> list[Path]:
    """Return the folders of the simulated pairs of a run.

    Raises:
        InputError: There are none, or the sessions of some were removed.
    """
    if dropped := list_dropped(run):
        raise InputError(
            f"{run.path}: the sessions of {len(dropped)} pairs were removed: `tunnelcd run PLAN --out {run.path} "
            "--keep sessions` makes them again"
        )
    pairs = [path.parents[1] for path in sorted(run.path.glob(f"pairs/*/*/{_CHANGES}"))]
    if not pairs:
        raise InputError(f"{run.path}: holds no simulated pairs: run the plan again with --keep sessions")
    return pairs


def list_pairs_blindly(run: RunFolder) -> list[Path]:
    """Return the same folders in the order of their opaque names, which tells nothing of scenarios and seeds.

    Raises:
        InputError: As `list_pairs`, or blind.json is damaged.
    """
    return sorted(list_pairs(run), key=partial(_opaque_name, _stored_salt(run) or _draw_salt()))


def name_blindly(run: RunFolder) -> dict[Path, str]:
    """Return the opaque name of each pair of a run that was exported blind; {} if it never was.

    Raises:
        InputError: blind.json is damaged.
    """
    salt = _stored_salt(run)
    return {} if salt is None else {pair: _opaque_name(salt, pair) for pair in list_pairs(run)}


def copy_session(source: Path, target: Path, name: str) -> None:
    """Write what a robot recorded in a simulated session: scans, odometry and sensor; all else stays behind.

    Raises:
        InputError: The session is damaged, or the copy cannot be written.
    """
    session = read_session(source)
    provenance = {"made_by": "tunnelcd export", "session": name}
    with SessionWriter(target, session.sensor, session.chunk_scans, provenance, session.n_returns) as writer:
        for chunk in session.chunks():
            writer.add(chunk)
        writer.close(session.odom_T_sensor)


def copy_pair(pair: Path, target: Path) -> None:
    """Write both sessions of a pair blind into an existing folder, all files with the same time.

    Raises:
        InputError: As `copy_session`.
    """
    for name in SESSIONS:
        copy_session(pair / name, target / name, name)
    for path in (target, *target.rglob("*")):
        os.utime(path, (TIME_S, TIME_S))


def _export(out: Path, names: Mapping[str, Path], copy: Callable[[Path, Path], object], progress: RunProgress) -> int:
    left = [name for name in sorted(names) if not (out / name / "before").is_dir()]
    for done, name in enumerate(left):
        progress.cells(name, done, len(left))
        with new_folder(out / name) as unfinished:
            copy(names[name], unfinished)
    progress.cells("done", len(left), len(left))
    return len(left)


def _draw_salt() -> str:
    """Draw the salt from the system. It has no seed: who knows the seed of a name could work out what it stands for."""
    return secrets.token_hex(32)


def _stored_salt(run: RunFolder) -> str | None:
    path = run.path / "blind.json"
    if not path.exists():
        return None
    return validate(_Names, Document(str(path), read_json(path, _EXPECTED))).salt


def _opaque_name(salt: str, pair: Path) -> str:
    """Return a keyed digest of a pair's place in its run and of its changes: another simulation has another name."""
    content = f"{pair.parent.name}/{pair.name}\n".encode() + read_bytes(pair / _CHANGES)
    return hashlib.blake2b(content, key=bytes.fromhex(salt), digest_size=8).hexdigest()


def _require_own(run: RunFolder, out: Path, names: set[str]) -> None:
    """Refuse an output folder inside the run, or one that holds something that this export does not write."""
    if Path(os.path.realpath(out)).is_relative_to(run.path.resolve()):  # Path.resolve dies of a loop
        raise InputError(f"{out}: lies in the run folder, beside the truth: name a folder outside of {run.path}")
    make_writable(out)
    own = names | {f".{name}.partial" for name in names}
    if others := sorted({path.name for path in out.iterdir()} - own):
        raise InputError(f"{out}: holds {others[0]}, which is no pair of this export: name a new or empty folder")
