"""Rows of the speed table for descriptors and the query: each against the limit that it must keep."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np

from cdpipe.descriptors.sphere import change_log_odds, describe_map
from cdpipe.merge.merge import merge_maps
from cdpipe.model.config import load_config
from cdpipe.query.query import find_regions
from eval.bench.merge import MergeSite
from sim.studies.timing import Contest, timed

_SPHERE_LIMIT_S = 0.003
_SCAN_LIMIT_S = 0.1  # a 10 Hz sensor
_N_REGIONS = 3
# The paper's t_CD per region (Table I): 0.016 to 0.019 s on site 1, 0.109 to 0.115 s on site 2.
_QUERY_LIMITS_S = {"60k": 0.016, "1400k": 0.109}


def descriptor_contests(sites: Sequence[MergeSite]) -> dict[str, Callable[[], Contest]]:
    """Return what can be measured of descriptors and query, by name, in the order of the table."""
    return {name: contest for site in sites for name, contest in _rows(site)}


def _rows(site: MergeSite) -> Iterator[tuple[str, Callable[[], Contest]]]:
    yield f"3deg-{site.size}-per-scan", partial(_scan, site)
    yield f"sphere-{site.size}-per-keyframe", partial(_sphere, site)
    yield f"query-{site.size}-per-region", partial(_query, site)


def _scan(site: MergeSite) -> Contest:
    session = site.sessions[0]
    n = len(session.mapped.map.keyframe_scans)
    return _limited([seconds / n for seconds in session.descriptor_s], _SCAN_LIMIT_S)


def _sphere(site: MergeSite) -> Contest:
    """Time both halves of a comparison: describing the before map, and looking at the after map from there."""
    before, after = (session.mapped for session in site.sessions)
    merged = merge_maps(before, after, site.config.merge)
    poses = before.map.odom_T_keyframe
    is_covered = np.ones(len(poses), np.bool_)

    def both() -> None:
        spheres = describe_map(before.map, poses, site.config.descriptor)
        change_log_odds(merged, replace(before.descriptors, spheres=spheres), is_covered)

    return _limited([seconds / len(poses) for seconds in timed(both, site.repeats)], _SPHERE_LIMIT_S)


def _query(site: MergeSite) -> Contest:
    """Time the paper's query, as its Table I has it: for each of the regions it gives."""
    before, after = (session.mapped for session in site.sessions)
    merged = merge_maps(before, after, site.config.merge)
    config = load_config("paper-topn", [f"query.n_regions={_N_REGIONS}"]).query

    def once() -> float:
        start = perf_counter()
        find_regions(merged, before.descriptors, after.descriptors, config)
        return (perf_counter() - start) / _N_REGIONS

    return _limited(
        [once() for _ in range(site.repeats + 1)][1:], _QUERY_LIMITS_S.get(site.size, _QUERY_LIMITS_S["60k"])
    )


def _limited(seconds: Sequence[float], limit_s: float) -> Contest:
    return Contest("s", tuple(seconds), None, f"its limit, {1000 * limit_s:g} ms", (limit_s,), 1.0)
