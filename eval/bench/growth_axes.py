"""The axes of `tunnelcd bench --growth`: which input grows, by which sizes, and the work that is measured at one size.

The sessions are of a synthetic tunnel (`eval.bench.corridor`), whose scans are made when they are read: nothing is
simulated, and nothing repeats along the way, which would let two maps be merged in several places. Making a scan counts
as `reading`, which is no stage of the table. Each size is measured in a process of its own (`measure_size`).
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import cdpipe
from cdpipe.core.geometry import Float64Array, Int64Array, invert, yaw_pose
from cdpipe.core.threads import THREADS
from cdpipe.descriptors import use_threads
from cdpipe.merge.merge import take_known_merge
from cdpipe.model.config import load_config
from cdpipe.model.report import ChangeRegions
from cdpipe.pipeline import detect_changes, map_pair
from eval.bench.corridor import CorridorScans
from eval.bench.meter import MeteredScans, StageMeter, peak_mb
from eval.plans.plan import Plan, load_plan
from eval.running.runfolder import RunFolder, write_json, write_tables
from eval.running.runner import list_cells, run_plan

# A tunnel of this radius has a million map points a kilometre in cells of 0.2 m.
_RADIUS_M, _HEAPS_M, _REGION_M = 4.4, 25.0, 4.5
_MAPPING = ("consistency", "mapping", "descriptors", "sphere descriptors", "merge", "query")
_PLAN_SEED, _FEW = 20000, 4


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of growth.

    Attributes:
        name: Its name.
        grows: What grows, in words with the unit.
        measure: Does the work of one size with a meter, and returns the size that was reached, in the axis's unit.
        stages: The stages that have rows.
        sizes: What is asked of `measure`, small to large.
        quick: The same for a test.
        large: Further sizes of `--large`.
    """

    name: str
    grows: str
    measure: Callable[[float, StageMeter], float]
    stages: Sequence[str]
    sizes: Sequence[float]
    quick: Sequence[float]
    large: Sequence[float] = ()


def list_axes() -> dict[str, Axis]:
    """Return the axes by name, in the order of the table."""
    cut = ("extraction",)
    every = (
        Axis("points", "map points, by the cell", _grow_points, _MAPPING[1:], (0.4, 0.28, 0.2, 0.14, 0.1),
             (0.8, 0.6, 0.4)),
        Axis("length", "path [m]", _grow_length, (*_MAPPING, *cut), (62.5, 125, 250, 500, 1000), (10, 20, 40),
             (2500, 5000)),
        Axis("surface", "path [m]", _grow_surface, ("surface",), (62.5, 125, 250, 500), (10, 20)),
        Axis("keyframes", "keyframes", _grow_keyframes, _MAPPING[2:], (8, 4, 2, 1, 0.5), (4, 2, 1)),
        Axis("regions", "regions", _grow_regions, cut, (4, 8, 16, 32, 64), (1, 2, 3), (128, 256)),
        Axis("objects", "objects", _grow_objects, cut, (4, 8, 16, 32, 64), (1, 2, 3), (128, 256)),
        Axis("pairs", "pairs of a plan", _grow_pairs, ("cells", "tables"), (25, 50, 100, 200, 400), (2, 4, 8), (4000,)),
    )  # fmt: skip
    return {axis.name: axis for axis in every}


def measure_size(document: Mapping[str, Any]) -> dict[str, Any]:
    """Measure one size of an axis: for `run_isolated`, which takes and returns what JSON can hold.

    Args:
        document: `axis` and `size`.

    Returns:
        `size` that was reached; `base_mb`, the memory before, and `peak_mb`, the most of the process; `stages`, the
        cost of each stage that the axis names.
    """
    axis, meter = list_axes()[document["axis"]], StageMeter()
    use_threads(THREADS)
    base_mb = peak_mb()
    reached = axis.measure(float(document["size"]), meter)
    meter.start("")
    stages = {name: asdict(cost) for name, cost in meter.costs.items() if name in axis.stages}
    return {"size": reached, "base_mb": base_mb, "peak_mb": max(base_mb, _most_mb(meter)), "stages": stages}


def _most_mb(meter: StageMeter) -> float:
    """Return the most memory of this process, MB: ru_maxrss, which no restart of the peak lowers where there is one."""
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return max([resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, *(c.peak_mb for c in meter.costs.values())])


def _corridors(
    meter: StageMeter, length_m: float, spacing_m: float, heaps_m: Float64Array
) -> tuple[tuple[MeteredScans, MeteredScans], Float64Array]:
    """Return the before and the after session, heaps in turns in one or the other, and before_T_after (4, 4)."""
    pose = yaw_pose(0.7, (30.0, -20.0, 1.0))
    before = CorridorScans(length_m, _RADIUS_M, spacing_m, heaps_m[::2].tolist(), seed=1)
    after = CorridorScans(length_m, _RADIUS_M, spacing_m, heaps_m[1::2].tolist(), seed=2, odom_T_world=pose)
    return (MeteredScans(before, meter), MeteredScans(after, meter)), invert(pose)


def _detect(meter: StageMeter, length_m: float, spacing_m: float, settings: Sequence[str] = ()) -> Mapping[str, float]:
    """Compare two sessions and return the evidence."""
    sessions, _ = _corridors(meter, length_m, spacing_m, np.arange(_HEAPS_M / 2, length_m, _HEAPS_M))
    return cdpipe.detect(*sessions, settings=settings, hooks=meter).evidence


def _grow_points(voxel_m: float, meter: StageMeter) -> float:
    return _detect(meter, 160.0, 1.0, [f"map.voxel_m={voxel_m}", "map.consistency=none"])["map_points_before"]


def _grow_length(length_m: float, meter: StageMeter) -> float:
    _detect(meter, length_m, 2.0, [f"query.n_regions={_count_heaps(length_m)}"])
    return length_m


def _grow_surface(length_m: float, meter: StageMeter) -> float:
    regions = f"query.n_regions={_count_heaps(length_m)}"
    _detect(meter, length_m, 2.0, [regions, "map.consistency=none", "surface.method=planes"])
    return length_m


def _count_heaps(length_m: float) -> int:
    return max(1, round(length_m / _HEAPS_M))


def _grow_keyframes(spacing_m: float, meter: StageMeter) -> float:
    length_m = 125.0
    _detect(meter, length_m, 0.5, [f"map.keyframe_spacing_m={spacing_m}", "map.consistency=none"])
    return float(np.floor(length_m / spacing_m) + 1)


def _grow_regions(n: float, meter: StageMeter) -> float:
    length_m = _way_m(n)
    _cut(meter, length_m, np.zeros(0), (np.arange(n) + 0.5) * length_m / n)
    return n


def _grow_objects(n: float, meter: StageMeter) -> float:
    length_m = _way_m(n)
    heaps_m = (np.arange(n) + 0.5) * length_m / n
    return float(_cut(meter, length_m, heaps_m, heaps_m))


def _way_m(n: float) -> float:
    """Return the path for n regions: the same for all sizes but those of a test and the largest."""
    return 30.0 if n < _FEW else max(320.0, 5.0 * n)


def _cut(meter: StageMeter, length_m: float, heaps_m: Float64Array, regions_m: Float64Array) -> int:
    """Cut objects out of regions on the way of two sessions whose merge is known; return the number of objects."""
    # these heaps hide nothing from afar, so a session sees through its own, as through what passes
    config = load_config("tunnelcd", ["map.consistency=none", "merge.refine=none", "extract.movers=keep"])
    sessions, before_T_after = _corridors(meter, length_m, 2.0, heaps_m)
    mapped = map_pair(sessions, config, meter).value
    way_m = sessions[0].odom_T_sensor[:, :3, 3]
    centres = np.column_stack([np.interp(regions_m, way_m[:, 0], way_m[:, axis]) for axis in range(3)])
    merge = partial(take_known_merge, before_T_after=before_T_after, config=config.merge)
    report = detect_changes(*mapped, config, meter, merge=merge, propose=partial(_propose, centres))
    return len(report.objects)


def _propose(centres: Float64Array, scans: tuple[Int64Array, Int64Array], radii_m: Float64Array) -> ChangeRegions:
    n = len(centres)
    none = np.zeros((n, 2), dtype=np.int64)
    return ChangeRegions(
        centres, _REGION_M, -np.arange(n, dtype=np.float64), none, np.ones(n, np.bool_), np.zeros(len(scans[0]))
    )


def _grow_pairs(n: float, meter: StageMeter) -> float:
    """List the cells of a plan of n pairs, all of them finished, and write its tables."""
    with TemporaryDirectory() as folder:
        made = RunFolder(Path(folder) / "made")
        plan = _one_pair()
        run_plan(plan, made)
        run = RunFolder(Path(folder) / "run")
        write_json(run.path / "provenance.json", made.provenance())
        stored = made.finished_cells()
        for number in range(int(n)):
            for cell in stored:
                row = cell["row"]
                seed = _PLAN_SEED + number
                path = run.cell(row["scenario"], seed, row["variant"])
                write_json(path, _as_seed(cell, seed))
        many = plan.model_copy(update={"seeds": tuple(range(_PLAN_SEED, _PLAN_SEED + int(n)))})
        meter.start("cells")
        list_cells(many, run.path)
        meter.start("tables")
        write_tables(run)
        meter.start("")
    return n


def _one_pair() -> Plan:
    """Return a plan of one pair and two variants."""
    plan = load_plan("smoke")
    chosen = tuple(variant for variant in plan.variants if variant.preset in ("paper", "voxel-diff"))
    return plan.model_copy(update={"scenarios": plan.scenarios[:1], "variants": chosen, "seeds": (_PLAN_SEED,)})


def _as_seed(cell: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return a finished cell as if it were of another seed."""
    copy: dict[str, Any] = json.loads(json.dumps(cell))
    copy["row"]["seed"] = seed
    for items in (value for value in copy.values() if isinstance(value, list)):
        for item in items:
            if isinstance(item, dict) and "seed" in item:
                item["seed"] = seed
    return copy
