"""Rows of the speed table for the merge: against its limits, and against KISS-Matcher with GICP, on both paper sites.

KISS-Matcher runs at the coarsest voxel that merged every pair of maps of that size with at least 45 % shared path
(validation seeds; reports/merge/notes). Its GICP is thinned to 0.8 m: against 0.4 m that takes half the time or
less and costs 5 mm at most.

Both methods end at an accepted rigid transform: ours starts from descriptors (all-in), stored vectors or indexed maps,
the rival from two clouds. All-in counts the descriptors of the keyframes that the merge compares: the first ones, and
all of them if these did not suffice. Refinement along the path is a row of its own, because the rival has no such step.
The time of a wrong rival is not compared. Where ours is refused or wrong, the row gives the reason and misses its
target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from cdpipe.core.errors import MergeFailedError
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, transform_each
from cdpipe.core.threads import THREADS
from cdpipe.descriptors import describe_scans, use_threads
from cdpipe.mapping.mapping import build_map
from cdpipe.merge.candidates import first_keyframes
from cdpipe.merge.global_registration import is_kiss_matcher_installed, register_globally
from cdpipe.merge.merge import merge_maps
from cdpipe.model.config import PipelineConfig, load_config
from cdpipe.model.types import DescriptorSet, MappedSession, PosedScan, ScanSource, SessionName, WrappedScans
from eval.truth.adapters import pipeline_input
from scenarios.library import load_scenario
from sim.session.simulate import simulate_pair
from sim.session.truth import read_true_poses
from sim.studies.timing import Contest, timed

_GICP_CELL_M = 0.8
_GICP_REACH_M = 2.4
# Keyframes whose descriptors are timed; a large site has two thousand, all alike.
_N_DESCRIBED = 64
_WRONG_M = 0.5
# Times do not depend on the width of the beams, and site 2 is simulated in a fifth of the time without it.
_SETTINGS = ("sensor.sub_rays=1",)
_NO_KISS = "KISS-Matcher: not installed (extra `kiss`)"
_ALL_IN = "ours: descriptors + index + merge to a rigid transform, as the rival gives; refinement is its own row"


@dataclass(frozen=True, slots=True)
class FailedContest(Contest):
    """A row that could not be timed, for example because our merge failed, with the reason."""

    reason: str = ""


@dataclass(frozen=True, slots=True)
class Goals:
    """Targets for maps of one size: seconds, and how many times faster than KISS-Matcher with GICP."""

    merge_s: float
    index_s: float
    ratio: float
    ratio_all_in: float
    refine_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BenchSession:
    """A session ready to be merged.

    Attributes:
        mapped: Its map and descriptors.
        world_T_odom: (K, 4, 4) true pose of its odom frame, as it is at each keyframe.
        descriptor_s: Seconds that the descriptors of all keyframes take, one for each repetition.
        first_share: Share of the keyframes that are described before the merge.
        asked: Not empty if a merge was refused with these, and asked for the others.
    """

    mapped: MappedSession
    world_T_odom: Float64Array
    descriptor_s: tuple[float, ...]
    first_share: float = 1.0
    asked: list[str] = field(default_factory=list)

    def needed_s(self) -> tuple[float, ...]:
        """Return the seconds of the descriptors that the merges needed."""
        share = 1.0 if self.asked else self.first_share
        return tuple(share * each for each in self.descriptor_s)


@dataclass(frozen=True)
class MergeSite:
    """A pair of sessions to merge, simulated at first use.

    Attributes:
        size: Approximate number of points of its maps; part of the rows' names.
        scenario: Name of a scenario.
        goals: Targets of its rows.
        kiss_voxel_m: The rival's voxel.
        seed: Seed of the world, from the training split.
        repeats: Number of repetitions of each timing.
    """

    size: str
    scenario: str
    goals: Goals
    kiss_voxel_m: float
    seed: int = 0
    repeats: int = 7

    @cached_property
    def config(self) -> PipelineConfig:
        """The default method, its network on one thread."""
        use_threads(THREADS)
        return load_config()

    @cached_property
    def sessions(self) -> tuple[BenchSession, BenchSession]:
        """The before and the after session."""
        with TemporaryDirectory() as folder:
            pair = Path(folder) / "pair"
            simulate_pair(load_scenario(self.scenario, self.seed, _SETTINGS), self.seed, pair)
            return self._session(pair, "before"), self._session(pair, "after")

    def _session(self, pair: Path, name: SessionName) -> BenchSession:
        source = pipeline_input(pair, name)
        point_map = build_map(source, self.config.map)
        chosen = point_map.keyframe_scans
        descriptors = describe_scans(source, chosen, self.config.descriptor)
        some = np.unique(np.linspace(0, len(chosen) - 1, min(len(chosen), _N_DESCRIBED)).round().astype(np.int64))
        held = _ScansInMemory(source, chosen[some].tolist())
        seconds = timed(lambda: describe_scans(held, chosen[some], self.config.descriptor), self.repeats)
        world_T_odom = read_true_poses(pair / name)[chosen] @ invert(point_map.odom_T_keyframe)
        asked: list[str] = []

        def describe_rest() -> DescriptorSet:
            asked.append(name)
            return descriptors

        return BenchSession(
            MappedSession(point_map, descriptors, describe_rest),
            world_T_odom,
            tuple(each * len(chosen) / len(some) for each in seconds),
            len(first_keyframes(len(chosen), self.config.described_every, name == "after")) / len(chosen),
            asked,
        )

    @cached_property
    def raced(self) -> tuple[list[Mapping[str, float]], list[float]]:
        """Seconds of the parts of each merge and of the rival's merges, timed in turns; the first of each is left out.

        Raises:
            MergeFailedError: Our merge is refused or wrong, so that its time says nothing.
        """
        ours, rival = [], []
        for number in range(self.repeats + 1):
            for is_ours in (True, False) if number % 2 else (False, True):
                if is_ours:
                    ours.append(self.merge("none"))
                elif is_kiss_matcher_installed():
                    start = perf_counter()
                    self.rival_pose()
                    rival.append(perf_counter() - start)
        return ours[1:], rival[1:]

    @cached_property
    def refined(self) -> list[Mapping[str, float]]:
        """Seconds of the parts of each merge with local refinement; the first is left out."""
        return [self.merge("local") for _ in range(max(3, self.repeats // 2) + 1)][1:]

    def merge(self, refine: str) -> Mapping[str, float]:
        """Merge once and return the seconds of its parts."""
        before, after = self.sessions
        config = self.config.merge.model_copy(update={"refine": refine})
        merged = merge_maps(before.mapped, after.mapped, config)
        missed_m = self.missed_m(merged.before_T_after)
        if not merged.is_accepted or missed_m > _WRONG_M:
            told = merged.reason or f"it is {missed_m:.1f} m off"
            raise MergeFailedError(f"{self.scenario} seed {self.seed} cannot be merged: {told}", merged.evidence)
        return merged.seconds

    def rival_pose(self) -> Float64Array | None:
        """Merge once with the rival and return before_T_after (4, 4); None where it finds nothing."""
        before, after = self.sessions
        return kiss_and_gicp(before.mapped.map.points, after.mapped.map.points, self.kiss_voxel_m)

    def missed_m(self, before_T_after: Float64Array) -> float:
        """Return the median distance of the after keyframes from their true places, metres."""
        before, after = self.sessions
        positions = after.mapped.map.odom_T_keyframe[:, :3, 3]
        places_before = transform_each(before.world_T_odom, before.mapped.map.odom_T_keyframe[:, :3, 3])
        _, nearest = cKDTree(places_before).query(transform_each(after.world_T_odom, positions))
        true = transform_each(invert(before.world_T_odom[nearest]) @ after.world_T_odom, positions)
        return float(np.median(np.linalg.norm(transform(before_T_after, positions) - true, axis=1)))

    @cached_property
    def rival(self) -> tuple[str, bool]:
        """Name of the rival, and whether its time can be compared: it is installed and right."""
        if not is_kiss_matcher_installed():
            return _NO_KISS, False
        name, pose = f"KISS-Matcher at {self.kiss_voxel_m} m and GICP", self.rival_pose()
        if pose is None:
            return f"{name}: not judged, it found nothing", False
        missed_m = self.missed_m(pose)
        return (f"{name}: not judged, {missed_m:.1f} m off", False) if missed_m > _WRONG_M else (name, True)


def paper_sites() -> tuple[MergeSite, MergeSite]:
    """Return the sites of the table: maps of some 60 thousand and 1.3 million points."""
    return (
        MergeSite("60k", "paper/site1", Goals(0.051, 0.1, 10.0, 3.0), kiss_voxel_m=0.7),
        MergeSite("1400k", "paper/site2", Goals(0.1, 0.3, 10.0, 5.0, 0.7), kiss_voxel_m=1.2, repeats=5),
    )


def kiss_and_gicp(before_points: Float64Array, after_points: Float64Array, voxel_m: float) -> Float64Array | None:
    """Return before_T_after (4, 4) from two clouds alone, on one thread; None where KISS-Matcher finds nothing."""
    found = register_globally(before_points, after_points, voxel_m)
    if found is None:
        return None
    # small_gicp solves for a turn about the origin, which may be far away
    centre = before_points.mean(axis=0)
    fine = small_gicp.align(
        before_points - centre,
        transform(found, after_points) - centre,
        registration_type="GICP",
        downsampling_resolution=_GICP_CELL_M,
        max_correspondence_distance=max(_GICP_REACH_M, 2 * voxel_m),
        num_threads=1,
    )
    pose = make_pose(translation=centre) @ fine.T_target_source @ make_pose(translation=-centre)
    return np.asarray(pose @ found)


def against_limit(seconds: Sequence[float], limit_s: float, remark: str = "") -> Contest:
    """Return the contest of some times against a limit, which stands in for the rival."""
    return Contest("s", tuple(seconds), None, f"its limit, {1000 * limit_s:g} ms{remark}", (limit_s,), 1.0)


def merge_contests(site: MergeSite) -> Iterator[tuple[str, Callable[[], Contest]]]:
    """Yield the rows of the merge with their names, in the order of the table."""
    goals = site.goals
    rows: dict[str, tuple[Callable[[], Contest], float | None]] = {
        "": (lambda: against_limit(_part(site, "t_merge_s"), goals.merge_s), 1.0),
        "-raced": (lambda: _raced(site, _part(site, "t_merge_s"), goals.ratio), goals.ratio),
        "-index": (lambda: against_limit(_part(site, "t_index_s"), goals.index_s), 1.0),
        "-all-in": (lambda: _raced(site, _all_in(site), goals.ratio_all_in, _ALL_IN), goals.ratio_all_in),
        "-refine": (lambda: _refined(site), None if goals.refine_s is None else 1.0),
    }
    for name, (contest, target) in rows.items():
        yield f"merge-{site.size}{name}", partial(_held, contest, target)


def _held(contest: Callable[[], Contest], target: float | None) -> Contest:
    try:
        return contest()
    except MergeFailedError as error:
        return FailedContest("s", (), target=target, reason=str(error))


def _refined(site: MergeSite) -> Contest:
    seconds, limit_s = tuple(each["t_refine_s"] for each in site.refined), site.goals.refine_s
    return Contest("s", seconds) if limit_s is None else against_limit(seconds, limit_s)


def _part(site: MergeSite, name: str) -> tuple[float, ...]:
    return tuple(each[name] for each in site.raced[0])


def _all_in(site: MergeSite) -> tuple[float, ...]:
    merges = _part(site, "t_index_s"), _part(site, "t_merge_s")
    described = [session.needed_s() for session in site.sessions]
    return tuple(map(sum, zip(*described, *merges, strict=True)))


def _raced(site: MergeSite, seconds: tuple[float, ...], target: float, ours: str = "") -> Contest:
    rival, is_comparable = site.rival
    told = f"{rival} ({ours})" if ours else rival
    return Contest("s", seconds, None, told, tuple(site.raced[1]) if is_comparable else (), target)


class _ScansInMemory(WrappedScans):
    """Some scans of a session in memory, as a robot has them."""

    def __init__(self, source: ScanSource, indices: Sequence[int]) -> None:
        super().__init__(source)
        self._scans = {index: source.scan(index) for index in indices}

    def scan(self, index: int) -> PosedScan:
        return self._scans[index]

    def scans(self) -> Iterator[PosedScan]:
        return iter(self._scans.values())
