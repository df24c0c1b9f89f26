"""Progress of reading: a session that tells how many of its scans were read."""

from __future__ import annotations

from collections.abc import Iterator

from cdpipe.core.progress import Progress
from cdpipe.model.types import PosedScan, ScanSource, WrappedScans


class CountedScans(WrappedScans):
    """A session that tells how many scans were read each time that all are read: step `pass 1`, `pass 2`, ..."""

    def __init__(self, source: ScanSource, on_step: Progress) -> None:
        super().__init__(source)
        self._on_step, self._n_passes = on_step, 0

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        self._n_passes += 1
        step, total = f"pass {self._n_passes}", len(self.odom_T_sensor)
        for done, scan in enumerate(super().scans()):
            self._on_step(step, done, total)
            yield scan
        self._on_step(step, total, total)
