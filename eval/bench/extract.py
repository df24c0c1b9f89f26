"""Rows of the speed table for the extraction of objects from a region, in CPU time of one thread.

`extract-voxel-N` is what the paper times: cropping a sphere of N points from two indexed maps, the voxel comparison in
one direction, and the outlier filter on the new points. `extract-surface-N` is the default rule's comparison of both
sessions with each other's surface, against its limit. Its other steps have rows of their own: cropping both spheres,
indexing them as surfaces, the local re-alignment, reading the returns (one pass over both sessions, whatever the number
of regions), and the comparison of one site. The default rule's spheres reach 1.5 m beyond their N points, to which
objects are followed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import thread_time

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array, transform
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.threads import THREADS
from cdpipe.descriptors import use_threads
from cdpipe.extract.crops import Crops, Sphere
from cdpipe.extract.objects import ReturnPool
from cdpipe.extract.point_comparison import inlier_mask, new_points_mask
from cdpipe.extract.surface import RIM_M, SITE_M, PlaneTable, compare_site, find_candidates
from cdpipe.extract.surface_rule import BEYOND_M, collect_rays, find_object_cells, realign
from cdpipe.mapping.free_space import free_space_votes
from cdpipe.merge.registration import Surface
from cdpipe.model.config import ExtractConfig, PipelineConfig, load_config
from cdpipe.model.types import KeyframeViews, MergedMaps, SessionName
from cdpipe.pipeline import Hooks, map_session, merge_mapped
from eval.bench.merge import against_limit
from eval.truth.adapters import pipeline_input
from scenarios.library import load_scenario
from sim.session.simulate import simulate_pair
from sim.studies.timing import Contest, timed

_REALIGN_LIMIT_S = 0.05
# One sphere per so many keyframes; the timed one has the median number of candidates of those with more than ten.
_STRIDE, _MIN_TELLING = 2, 10


@dataclass(frozen=True)
class ExtractSite:
    """A pair of sessions with objects to extract, simulated at first use.

    Attributes:
        n_points: Points of the after map in the sphere; part of the rows' names.
        scenario: Name of a scenario.
        voxel_s: Limit of the paper's rule.
        surface_s: Limit of the default rule's comparison.
        paper: The paper's own time, in words.
        all_in_s: Limit of all steps of the default rule together.
        seed: Seed of the world, from the training split.
        repeats: Number of repetitions of each timing.
    """

    n_points: int
    scenario: str
    voxel_s: float
    surface_s: float
    paper: str
    all_in_s: float | None = None
    seed: int = 0
    repeats: int = 31

    @cached_property
    def config(self) -> PipelineConfig:
        """The default method."""
        use_threads(THREADS)
        return load_config()

    @cached_property
    def merged(self) -> MergedMaps:
        """Both maps, aligned along the path."""
        with TemporaryDirectory() as folder:
            pair = Path(folder) / "pair"
            simulate_pair(load_scenario(self.scenario, self.seed), self.seed, pair)
            before, after = (map_session(pipeline_input(pair, name), self.config) for name in ("before", "after"))
        return merge_mapped(before, after, self.config, Hooks())

    @cached_property
    def region(self) -> Region:
        """Of the spheres of `n_points` points along the before path that hold a site, the one of median size."""
        after_map = self.merged.alignment.to_map(self.merged.after.points)
        tried = []
        for centre in self.merged.before.odom_T_keyframe[::_STRIDE, :3, 3]:
            gaps_m = np.linalg.norm(after_map - centre, axis=1)
            radius_m = float(np.partition(gaps_m, self.n_points - 1)[self.n_points - 1])
            tried.append(Region(self.merged, centre, radius_m))
        changed = sorted(
            (region for region in tried if len(region.telling) > _MIN_TELLING), key=lambda each: len(each.telling)
        )
        return changed[len(changed) // 2]


@dataclass(frozen=True)
class Region:
    """One sphere of both maps; the steps of the default rule are its properties, computed once."""

    merged: MergedMaps
    centre_map: Float64Array
    radius_m: float

    @cached_property
    def crops(self) -> Crops:
        """The index of both maps."""
        return Crops(self.merged, BEYOND_M)

    @cached_property
    def spheres(self) -> dict[SessionName, Sphere]:
        """Both spheres with the margin."""
        return self.crops.around(self.centre_map, self.radius_m)

    @cached_property
    def before_surface(self) -> Surface:
        """The before sphere, indexed."""
        return Surface(self.spheres["before"].points)

    @cached_property
    def correction(self) -> Float64Array:
        """(4, 4) alignment of the after sphere with the before one."""
        return realign(self.spheres["after"].points, self.centre_map, self.before_surface)

    @cached_property
    def after_points(self) -> Float64Array:
        """(N, 3) the after sphere as re-aligned, map frame."""
        return transform(self.correction, self.spheres["after"].points)

    @cached_property
    def tables(self) -> tuple[PlaneTable, PlaneTable]:
        """The before and the after sphere, indexed and with a plane for each cell."""
        return PlaneTable(Surface(self.spheres["before"].points)), PlaneTable(Surface(self.after_points))

    @cached_property
    def compared(self) -> tuple[tuple[Int64Array, float], tuple[Int64Array, float]]:
        """The candidates of the after and of the before sphere, and how well they agree with the other one."""
        before, after = self.tables
        return find_candidates(self.after_points, before), find_candidates(self.spheres["before"].points, after)

    @cached_property
    def telling(self) -> Int64Array:
        """(N,) candidates of the after sphere, without its margin, that the before session saw through."""
        chosen = self.compared[0][0]
        chosen = chosen[self.spheres["after"].is_inside[chosen]]
        return chosen[free_space_votes(self.after_points[chosen], _views(self.merged)) > 0]

    @cached_property
    def site(self) -> tuple[Int64Array, Int64Array]:
        """The after and the before map points around the largest group of candidates."""
        labels, sizes = label_groups(self.after_points[self.telling], SITE_M)
        members = self.telling[labels == np.argmax(sizes)]
        in_map = self.spheres["after"].points[members]
        return self.crops.near("after", in_map, SITE_M), self.crops.near("before", in_map, SITE_M + RIM_M)

    @cached_property
    def pools(self) -> tuple[ReturnPool, ReturnPool]:
        """The returns at the site, read from both sessions."""
        own, others = self.site
        return ReturnPool(self.merged.after, [own]), ReturnPool(self.merged.before, [others])

    @cached_property
    def returns(self) -> tuple[Int64Array, Int64Array]:
        """Returns of the after and of the before session at the site."""
        (own, others), (own_pool, other_pool) = self.site, self.pools
        return own_pool.of(own), other_pool.of(others)

    def look_closely(self, config: ExtractConfig) -> list[Int64Array]:
        """Compare the returns of the largest site, count free-space votes and grazing rays, and grow its objects."""
        own, others = self.returns
        in_map = self.merged.alignment.to_map(self.merged.after.positions_of(own))
        ends = self.merged.before.positions_of(others)
        site = compare_site(transform(self.correction, in_map), ends)
        noise_m = max(median_m for _, median_m in self.compared)
        rays = partial(collect_rays, self.merged, "before", others, ends, self.correction)
        return find_object_cells(site, free_space_votes(site.points, _views(self.merged)), rays, noise_m, config)


def extract_sites() -> tuple[ExtractSite, ExtractSite]:
    """Return the sites of the table: spheres as large as those of the paper's two."""
    return (
        ExtractSite(2500, "train/narrow", 0.0005, 0.0015, "0.5 ms"),
        ExtractSite(15000, "train/wide", 0.0025, 0.006, "5.7 to 11 ms", 0.025),
    )


def extract_contests(site: ExtractSite) -> Iterator[tuple[str, Callable[[], Contest]]]:
    """Yield the rows of the extraction with their names, in the order of the table."""
    size = site.n_points
    yield f"extract-voxel-{size}", partial(_voxel, site, ("after",))
    yield f"extract-voxel-{size}-both", partial(_voxel, site, ("after", "before"))
    steps: dict[str, tuple[Callable[[Region], object], float | None]] = {
        "": (_compute_again("compared"), site.surface_s),
        "-crop": (_compute_again("spheres"), None),
        "-index": (_compute_again("tables"), None),
        "-realign": (_compute_again("correction"), _REALIGN_LIMIT_S),
        "-returns": (_compute_again("pools"), None),
        "-site": (lambda region: region.look_closely(site.config.extract), None),
    }
    for name, (step, limit_s) in steps.items():
        yield f"extract-surface-{size}{name}", partial(_step, site, step, limit_s)
    every = [step for step, _ in steps.values()]
    yield f"extract-surface-{size}-all-in", partial(_step, site, partial(_take_all, every), site.all_in_s)


def _compute_again(name: str) -> Callable[[Region], object]:
    """Return the step behind a cached property."""
    step: Callable[[Region], object] = vars(Region)[name].func
    return step


def _take_all(steps: Sequence[Callable[[Region], object]], region: Region) -> None:
    for step in steps:
        step(region)


def _step(site: ExtractSite, step: Callable[[Region], object], limit_s: float | None) -> Contest:
    region = site.region
    seconds = timed(lambda: step(region), site.repeats, thread_time)
    return Contest("s", seconds) if limit_s is None else against_limit(seconds, limit_s)


def _voxel(site: ExtractSite, sessions: Sequence[SessionName]) -> Contest:
    """Time the paper's rule on the same sphere, with one rigid alignment for the whole map."""
    config = load_config("paper")
    crops = Crops(replace(site.merged, local=None), float(np.sqrt(3.0)) * config.extract.voxel_m)
    centre_map, radius_m = site.region.centre_map, site.region.radius_m

    def once() -> None:
        spheres = crops.around(centre_map, radius_m)
        for session in sessions:
            _, points = spheres[session].inside
            others = spheres["before" if session == "after" else "after"].points
            inlier_mask(points[new_points_mask(points, others, config.extract)], config.outlier)

    seconds = timed(once, site.repeats, thread_time)
    if len(sessions) > 1:
        return Contest("s", seconds)
    return against_limit(seconds, site.voxel_s, f" (the paper: {site.paper})")


def _views(merged: MergedMaps) -> KeyframeViews:
    if merged.before.views is None:
        raise ValueError("the before map has no keyframe views")
    return merged.before.views
