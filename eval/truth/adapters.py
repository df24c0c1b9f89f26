"""The only place where a simulated session becomes input of a method, so that truth cannot leak into it."""

from __future__ import annotations

from pathlib import Path

from cdpipe.io.readers import RecordedScans, open_session
from cdpipe.io.session import Session
from cdpipe.model.types import ScanSource, SessionName


def pipeline_input(pair: Path, session: SessionName) -> ScanSource:
    """Open one session of a simulated pair as the pipeline sees it: scans and the robot's own poses, never truth.

    Args:
        pair: Folder of the pair; truth lies in its `truth` folders and is not opened.
        session: "before" or "after".

    Raises:
        InputError: The session is missing or damaged.
    """
    return open_session(pair / session)


def held_input(session: Session) -> ScanSource:
    """Return a session held in memory (`sim.session.simulate`) as the pipeline sees it, without its truth."""
    return RecordedScans(session)
