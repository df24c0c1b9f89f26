"""What `tunnelcd convert` is asked to write."""

from __future__ import annotations

from dataclasses import dataclass

from cdpipe.core.errors import InputError
from cdpipe.io.out.scans import Outgoing
from cdpipe.io.session import Session
from cdpipe.model.types import ScanSource
from eval.converting.truth import truth_fields
from eval.core.terminal.progress import RunProgress


@dataclass(frozen=True, slots=True)
class Request:
    """A session or a recording that leaves.

    Attributes:
        source: What is written.
        session: Its session folder; None of other recordings.
        progress: Told of the writing.
        with_truth: Whether the truth beside the session leaves, too.
        cell_m: Edge of the cells by which maps are thinned, metres.
    """

    source: ScanSource
    session: Session | None
    progress: RunProgress
    with_truth: bool = False
    cell_m: float = 0.05

    def outgoing(self) -> Outgoing:
        """Return its scans, with the truth of each return if that leaves."""
        return Outgoing(self.source, truth_fields(self.own_session()) if self.with_truth else None)

    def own_session(self) -> Session:
        """Return its session.

        Raises:
            InputError: It is a recording of another format.
        """
        if self.session is None:
            raise InputError(f"{self.source.name}: no session folder: name one, or a format for recordings")
        return self.session
