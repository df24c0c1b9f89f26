"""`tunnelcd convert`: a session becomes an OSF; an OSF or a PCAP becomes a session."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.io.ouster.osf import Fields, write_osf
from cdpipe.io.ouster.recording import import_recording
from cdpipe.io.readers import RECORDING_SUFFIXES
from cdpipe.io.session import Session, is_session, read_session
from eval.core.output import made_parents
from eval.core.progress import RunProgress
from sim.session.truth import read_labels


def convert(
    source: Path,
    out: Path,
    progress: RunProgress,
    *,
    metadata: Path | None = None,
    trajectory: Path | None = None,
    odometry: str | None = None,
    without_truth: bool = False,
) -> str:
    """Convert a session folder to an .osf, or a recording to a session folder; return what was done, in words.

    Nothing is left behind where it fails or is interrupted.

    Raises:
        InputError: The kind of either file cannot be converted, `out` exists, or an option belongs to the other
            direction.
    """
    if source.is_dir():
        for name, value in {"metadata": metadata, "trajectory": trajectory, "odometry": odometry}.items():
            if value is not None:
                raise InputError(f"{source}: a session has its own poses and sensor: leave --{name} out")
        return _export(source, out, progress, without_truth=without_truth)
    if source.suffix.lower() not in RECORDING_SUFFIXES:
        what = "expected a session folder" if source.exists() else "no such file or folder: expected a session"
        raise InputError(f"{source}: {what}, or a recording ({', '.join(RECORDING_SUFFIXES)})")
    if without_truth:
        raise InputError(f"{source}: a recording has no truth: leave --without-truth out")
    if out.suffix.lower() in RECORDING_SUFFIXES:
        raise InputError(f"{out}: a recording becomes a session: name a new folder")
    with made_parents(out):
        imported = import_recording(
            source,
            out,
            metadata=metadata,
            trajectory=trajectory,
            odometry=odometry,
            on_progress=progress.stage,
        )
    told = f"{out}: session of {_revolutions(imported.n_scans)}, {imported.sensor}, poses: {imported.poses}"
    left_out = f"; {imported.n_left_out} left out, of which half the columns or fewer arrived"
    return told + left_out if imported.n_left_out else told


def _export(source: Path, out: Path, progress: RunProgress, *, without_truth: bool) -> str:
    if out.suffix.lower() != ".osf":
        raise InputError(f"{out}: a session becomes an OSF: name a new file that ends in .osf")
    if is_session(source / "before"):
        raise InputError(f"{source}: a pair of sessions: convert {source / 'before'} and {source / 'after'} one by one")
    session = read_session(source)
    has_truth = (source / "truth").is_dir() and not without_truth
    with made_parents(out):
        write_osf(session, out, _truth_fields(session) if has_truth else None, progress.stage)
    also = "with truth as fields LABEL and INSTANCE" if has_truth else "without truth"
    return f"{out}: {_revolutions(session.n_scans)}, {also}, {out.stat().st_size / 1e6:.1f} MB"


def _revolutions(n: int) -> str:
    return "1 revolution" if n == 1 else f"{n} revolutions"


def _truth_fields(session: Session) -> Iterator[Fields]:
    """Yield LABEL (uint16: the change's id, 0 none) and INSTANCE (int16, as in sim.session.truth) of each chunk."""
    for instance, change in read_labels(session.path, session.n_chunks):
        yield {"LABEL": change.astype(np.uint16), "INSTANCE": instance.astype(np.int16)}
