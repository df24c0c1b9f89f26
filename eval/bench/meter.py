"""What each stage of `detect` costs in this process: wall clock, CPU time of all threads, and peak memory."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdpipe.model.types import PosedScan, ScanSource, WrappedScans
from cdpipe.pipeline import Done, Hooks

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
# Whether the first pass over a session belongs to its map or to its consistent poses is known by what follows.
_FIRST_PASS = "pass 1"
_STAGES = {
    "map before": "mapping", "map after": "mapping", "describe keyframes": "descriptors",
    "describe spheres": "sphere descriptors",
}  # fmt: skip


@dataclass(slots=True)
class StageCost:
    """Wall-clock seconds, CPU seconds of all threads, and the peak of the process's memory meanwhile, MB; else NaN."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = float("nan")


class StageMeter(Hooks):
    """Measures one stage after the other. As hooks it follows those of `detect`; `start` begins any other.

    Attributes:
        costs: What each stage has cost so far; a stage that was left and entered again has the sum.
    """

    def __init__(self) -> None:
        super().__init__(self._follow)
        self.costs: dict[str, StageCost] = {}
        self._stage = ""
        self._began = (0.0, 0.0)

    def time(self, compute: Callable[[], Done[Any]]) -> Done[Any]:
        """Measure the extraction; the query and the surface, which it may contain, name themselves."""
        self.start("extraction")
        return super().time(compute)

    def start(self, stage: str) -> None:
        """End the present stage and begin another one; "" begins none."""
        if stage == self._stage:
            return
        self._book()
        if self._stage:
            cost = self.costs[self._stage]
            cost.peak_mb = _larger(peak_mb(), cost.peak_mb)
        self._stage = stage
        if stage:
            self.costs.setdefault(stage, StageCost())
            restart_peak()
        if stage != _FIRST_PASS:
            self._settle("consistency" if stage == "consistency" else "mapping")
        self._began = time.perf_counter(), time.process_time()

    def _settle(self, stage: str) -> None:
        """Book what the first pass has cost on a stage."""
        first = self.costs.pop(_FIRST_PASS, None)
        if first is not None:
            cost = self.costs.setdefault(stage, StageCost())
            cost.wall_s, cost.cpu_s = cost.wall_s + first.wall_s, cost.cpu_s + first.cpu_s
            cost.peak_mb = _larger(first.peak_mb, cost.peak_mb)

    @contextmanager
    def aside(self, stage: str) -> Iterator[None]:
        """Book the time of a block on another stage, within the present one; memory is not measured."""
        self._book()
        within, self._stage = self._stage, stage
        self.costs.setdefault(stage, StageCost())
        self._began = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self._book()
            self._stage = within
            self._began = time.perf_counter(), time.process_time()

    def _book(self) -> None:
        if self._stage:
            self.costs[self._stage].wall_s += time.perf_counter() - self._began[0]
            self.costs[self._stage].cpu_s += time.process_time() - self._began[1]

    def _follow(self, name: str, done: int, total: int) -> None:
        stage, _, step = name.partition(": ")
        is_registered = bool(step) and not step.startswith("pass ")
        self.start("consistency" if is_registered else step if step == _FIRST_PASS else _STAGES.get(stage, stage))


class MeteredScans(WrappedScans):
    """A session whose reading is booked as stage `reading`, not on the stage that reads."""

    def __init__(self, source: ScanSource, meter: StageMeter) -> None:
        super().__init__(source)
        self._meter = meter

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        with self._meter.aside("reading"):
            return super().scan(index)

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        scans = super().scans()
        while True:
            with self._meter.aside("reading"):
                scan = next(scans, None)
            if scan is None:
                return
            yield scan


def _larger(one: float, other: float) -> float:
    """Return the larger of two figures; NaN is none."""
    return one if math.isnan(other) else max(one, other)


def peak_mb() -> float:
    """Return the peak of this process's memory since `restart_peak`, MB; NaN where the system does not tell."""
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM"):
                return int(line.split()[1]) / 1e3
    return float("nan")


def restart_peak() -> None:
    """Let the peak begin anew, where the system can."""
    with suppress(OSError):
        _CLEAR.write_text("5")
