"""Rows of the speed table for what a user waits for: a world, training data, the comparison of two recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import cdpipe
from cdpipe.core.threads import THREADS
from cdpipe.descriptors import use_threads
from cdpipe.sensor.ouster import load_profile
from cdpipe.training.shard import read_about
from eval.bench.merge import against_limit
from eval.training.dataset import Recipe, make_shard
from scenarios.library import load_scenario
from sim.session.planning import plan_drives
from sim.session.simulate import simulate_pair
from sim.studies.timing import Contest, timed

# Seconds of the comparison itself, the merge left out: regions, objects.
_COMPARING = ("t_cd_s", "t_oe_s")


@dataclass(frozen=True)
class WholeSite:
    """The worlds of the rows.

    Attributes:
        wide: Scenario that is built and settled.
        world_s: Limit of its world and drives.
        training: Family of which a tunnel of training data is made.
        pairs_per_s: Least keyframe pairs a second that one process makes.
        recorded: Scenario of the two recordings.
        speed: How many times faster than it was recorded a pair should be compared.
        ratio: How many times faster than `m3c2` on the same maps.
        seed: Seed of all, from the training split.
        repeats: Repetitions.
    """

    wide: str = "wide"
    world_s: float = 1.2
    training: str = "train/narrow"
    pairs_per_s: float = 25.0
    recorded: str = "paper/site1"
    speed: float = 50.0
    ratio: float = 4.0
    seed: int = 0
    repeats: int = 3

    @cached_property
    def compared(self) -> tuple[float, list[tuple[float, float, float]]]:
        """Seconds that both recordings took; of each repetition: of `detect`, of its comparison, of `m3c2`'s."""
        use_threads(THREADS)
        scenario = load_scenario(self.recorded, self.seed)
        found = []
        with TemporaryDirectory() as folder:
            pair = Path(folder) / "pair"
            simulate_pair(scenario, self.seed, pair)
            n_scans = sum(len(cdpipe.open_session(pair / name).odom_T_sensor) for name in ("before", "after"))
            for number in range(self.repeats):
                presets = ("tunnelcd", "m3c2") if number % 2 else ("m3c2", "tunnelcd")
                seconds = {preset: _compare(pair, preset) for preset in presets}
                found.append((*seconds["tunnelcd"], seconds["m3c2"][1]))
        return n_scans / load_profile(scenario.sensor.profile, scenario.sensor.mode).rate_hz, found


def whole_contests(site: WholeSite | None = None) -> dict[str, Callable[[], Contest]]:
    """Return the measurements by name, in the order of the table."""
    site = site or WholeSite()
    return {
        f"world-{site.wide}": lambda: _world(site),
        "dataset-per-process": lambda: _training_data(site),
        "detect-60k": lambda: _detect(site),
        "compare-60k": lambda: _after_merge(site),
    }


def _world(site: WholeSite) -> Contest:
    scenario = load_scenario(site.wide, site.seed)
    sensor = load_profile(scenario.sensor.profile, scenario.sensor.mode)
    return against_limit(timed(lambda: plan_drives(scenario, site.seed, sensor), site.repeats), site.world_s)


def _training_data(site: WholeSite) -> Contest:
    shards: list[bytes] = []
    recipe = Recipe()
    seconds = timed(lambda: shards.append(make_shard(site.training, site.seed, recipe)), site.repeats)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "shard.npz"
        path.write_bytes(shards[0])
        n_pairs = int(read_about(path)["counts"]["n_before"])
    limit = f"its limit, {site.pairs_per_s:g} pairs/s"
    return Contest("pairs/s", seconds, n_pairs, limit, (n_pairs / site.pairs_per_s,), 1.0)


def _detect(site: WholeSite) -> Contest:
    recorded_s, seconds = site.compared
    taken = tuple(each[0] for each in seconds)
    return Contest("s/s", taken, recorded_s, "the time both recordings took", (recorded_s,), site.speed)


def _after_merge(site: WholeSite) -> Contest:
    _, seconds = site.compared
    ours, theirs = (tuple(each[place] for each in seconds) for place in (1, 2))
    return Contest("s", ours, None, "m3c2 on the same maps: regions and objects", theirs, site.ratio)


def _compare(pair: Path, preset: str) -> tuple[float, float]:
    """Compare both sessions, reading included; return the seconds of all, and those of regions and objects."""
    start = perf_counter()
    report = cdpipe.detect(pair / "before", pair / "after", preset=preset)
    return perf_counter() - start, sum(report.seconds.get(part, 0.0) for part in _COMPARING)
