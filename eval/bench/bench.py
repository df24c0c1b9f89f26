"""The speed table: its rows, the measurement of each beside its rival in the same run, and the file.

A new part of the table is a dictionary of named functions that return `sim.studies.timing.Contest`, joined in
`list_contests`. A ratio says how many times faster than its rival something is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError, TunnelcdError
from cdpipe.core.progress import Progress
from cdpipe.core.whole_file import whole_file
from cdpipe.core.yamlfile import suggest
from cdpipe.descriptors.sphere import anchor_frames, change_log_odds, describe_map
from cdpipe.merge.merge import merge_maps
from cdpipe.model.config import load_config
from cdpipe.query.query import find_regions
from eval.bench.extract import ExtractSite, extract_contests, extract_sites
from eval.bench.merge import FailedContest, MergeSite, against_limit, merge_contests, paper_sites
from eval.bench.whole import WholeSite, whole_contests
from eval.core.output import make_writable, require_replaceable, unwritable
from eval.core.provenance import machine
from sim.studies.bench import BenchSite, sensor_contests
from sim.studies.timing import Contest, SkippedContest, timed

Contests = Mapping[str, Callable[[], Contest]]
Row = dict[str, Any]
_HEAD = b'"machine": {'
_SPHERE_LIMIT_S = 0.003
_SCAN_LIMIT_S = 0.1  # a 10 Hz sensor
_N_REGIONS = 3
# The paper's t_CD per region (Table I): 0.016 to 0.019 s on site 1, 0.109 to 0.115 s on site 2.
_QUERY_LIMITS_S = {"60k": 0.016, "1400k": 0.109}


def list_contests(
    site: BenchSite | None = None,
    merge_sites: Sequence[MergeSite] | None = None,
    spheres: Sequence[ExtractSite] | None = None,
    whole: WholeSite | None = None,
) -> dict[str, Callable[[], Contest]]:
    """Return every row's measurement by name, in the order of the table."""
    sites = merge_sites or paper_sites()
    return {
        **sensor_contests(site or BenchSite()),
        **{name: contest for each in sites for name, contest in merge_contests(each)},
        **{name: contest for each in sites for name, contest in descriptor_contests(each)},
        **{name: contest for each in spheres or extract_sites() for name, contest in extract_contests(each)},
        **whole_contests(whole),
    }


def choose(every: Contests, only: Sequence[str]) -> Contests:
    """Return the contests of some names, or all of them if none is named.

    Raises:
        InputError: A name is unknown.
    """
    unknown = [name for name in only if name not in every]
    if unknown:
        wrong = "; ".join(f"{name!r} is no row of the table{suggest(name, list(every))}" for name in unknown)
        raise InputError(f"--only: {wrong} (known: {', '.join(every)})")
    return {name: contest for name, contest in every.items() if not only or name in only}


def measure(every: Contests, on_progress: Progress | None = None) -> dict[str, Any]:
    """Run the contests one after the other.

    Args:
        every: What to measure, by name.
        on_progress: Called with the name, how many are done, and how many there are.

    Returns:
        `machine` and `rows`, as the file has them.
    """
    rows = []
    for done, (name, contest) in enumerate(every.items()):
        if on_progress is not None:
            on_progress(name, done, len(every))
        rows.append(make_row(name, _attempt(contest)))
    return {"machine": machine(), "rows": rows}


def _attempt(contest: Callable[[], Contest]) -> Contest:
    """Measure a row; one that cannot be measured costs no other."""
    try:
        return contest()
    except TunnelcdError as error:
        return FailedContest("", (), reason=str(error))


def make_row(name: str, contest: Contest) -> Row:
    """Return one row of the table.

    `value` and `rival_value` are medians over `n` repetitions; `spread` is the distance between the quartiles of
    `value`. `ratio` tells how many times faster than its rival it is, and `met` whether that reaches `target`; both are
    None without a rival that can be compared. What failed has no value, `met` is False and `reason` says why; what this
    machine cannot do has no value, `met` is None and `reason` says what is missing; `reason` is "" everywhere else.
    """
    row = dict.fromkeys(("name", "value", "unit", "rival", "rival_value", "ratio", "target", "met", "n", "spread"))
    row |= {"name": name, "unit": contest.unit, "target": contest.target}
    if isinstance(contest, FailedContest):
        return row | {"met": False, "n": 0, "reason": contest.reason}
    if isinstance(contest, SkippedContest):
        return row | {"n": 0, "reason": contest.reason}
    figures = _figures(contest, contest.seconds)
    value = float(np.median(figures))
    rival = float(np.median(_figures(contest, contest.rival_seconds))) if contest.rival_seconds else None
    ratio = None if rival is None else value / rival if contest.work is not None else rival / value
    low, high = np.quantile(figures, [0.25, 0.75])
    return row | {
        "value": value,
        "rival": contest.rival,
        "rival_value": rival,
        "ratio": ratio,
        "met": None if ratio is None or contest.target is None else ratio >= contest.target,
        "n": len(figures),
        "spread": float(high - low),
        "reason": "",
    }


def summarise(rows: Sequence[Row]) -> str:
    """Return one line: how many targets are met, which are missed, and which had no rival to be judged by."""
    judged = [row for row in rows if row["met"] is not None]
    missed = [row["name"] for row in judged if not row["met"]]
    open_ones = [row["name"] for row in rows if row["met"] is None and row["target"] is not None]
    told = f"{len(judged) - len(missed)} of {len(judged)} targets met"
    if missed:
        told += f"; missed: {', '.join(missed)}"
    if open_ones:
        told += f"; {len(open_ones)} not judged: {', '.join(open_ones)}"
    return told


def list_reasons(rows: Sequence[Row]) -> list[str]:
    """Return one line for every row that failed or was skipped."""
    return [f"{row['name']}: {row['reason']}" for row in rows if row["reason"]]


def require_writable(path: Path, *, growth: bool = False, profile: bool = False) -> None:
    """Check before the measurement that the table, and what is written beside it, can be written.

    Raises:
        InputError: It cannot.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder: name a file for the table")
    beside = (".csv", ".png") * growth + (".md",) * profile
    if path.suffix in beside:
        raise InputError(f"{path}: a file of this name is written beside the table: name one that ends in .json")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: a device or a pipe: name a file for the table")
    require_replaceable(path, _HEAD, "table of `tunnelcd bench`")
    for other in (path.with_suffix(suffix) for suffix in beside if not path.exists()):
        if other.exists():
            raise InputError(f"{other}: exists, and no table {path.name} beside it: name a new file, or remove it")
    make_writable(path.absolute().parent)


def write_table(table: Mapping[str, Any], path: Path) -> None:
    """Write the table as JSON; the file appears under its name only when it is whole.

    Raises:
        InputError: It cannot be written there.
    """
    try:
        with whole_file(path) as partial:
            partial.write_text(json.dumps(table, indent=1) + "\n")
    except OSError as error:
        raise unwritable(path, error) from error


def _figures(contest: Contest, seconds: Sequence[float]) -> list[float]:
    return [each if contest.work is None else contest.work / each for each in seconds]


def descriptor_contests(site: MergeSite) -> Iterator[tuple[str, Callable[[], Contest]]]:
    """Yield the rows of descriptors and query with their names, each against its limit."""
    yield f"3deg-{site.size}-per-scan", partial(_scan, site)
    yield f"sphere-{site.size}-per-keyframe", partial(_sphere, site)
    yield f"query-{site.size}-per-region", partial(_query, site)


def _scan(site: MergeSite) -> Contest:
    session = site.sessions[0]
    n = len(session.mapped.map.keyframe_scans)
    return against_limit([seconds / n for seconds in session.descriptor_s], _SCAN_LIMIT_S)


def _sphere(site: MergeSite) -> Contest:
    """Time both halves of a comparison: describing the before map, and comparing the after map with it."""
    before, after = (session.mapped for session in site.sessions)
    merged = merge_maps(before, after, site.config.merge)
    sphere = site.config.sphere
    poses = anchor_frames(before.map, before.map.keyframe_scans, sphere)
    is_covered = np.ones(len(poses), np.bool_)

    def both() -> None:
        spheres = describe_map(before.map, poses, site.config.descriptor, sphere)
        change_log_odds(merged, replace(before.descriptors, spheres=spheres), is_covered, sphere)

    return against_limit([seconds / len(poses) for seconds in timed(both, site.repeats)], _SPHERE_LIMIT_S)


def _query(site: MergeSite) -> Contest:
    """Time the paper's query per region, as its Table I does."""
    before, after = (session.mapped for session in site.sessions)
    merged = merge_maps(before, after, site.config.merge)
    config = load_config("paper-topn", [f"query.n_regions={_N_REGIONS}"])
    seconds = timed(lambda: find_regions(merged, before.descriptors, after.descriptors, config), site.repeats)
    per_region_s = [each / _N_REGIONS for each in seconds]
    return against_limit(per_region_s, _QUERY_LIMITS_S.get(site.size, _QUERY_LIMITS_S["60k"]))
