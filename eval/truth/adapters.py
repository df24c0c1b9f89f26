"""The only place where a simulated session becomes input of a method, so that truth cannot leak into it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cdpipe.core.geometry import Float64Array
from cdpipe.io.readers import RecordedScans, open_session
from cdpipe.io.session import Session
from cdpipe.model.types import PosedScan, ScanSource, SessionName


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


class WrappedScans(ScanSource):
    """A source of scans that reads from another one; subclasses replace how scans are read."""

    def __init__(self, source: ScanSource) -> None:
        self._source = source

    @property
    def name(self) -> str:
        """Name of the session in messages."""
        return self._source.name

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each scan."""
        return self._source.odom_T_sensor

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        return self._source.scan(index)

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        return self._source.scans()
