"""How clean a session's own map is of what moved while it was recorded: accuracies of DynamicMap_Benchmark.

A map point is dynamic if more than half of its returns came from movers. SA is the share of the static points of the
raw map that a cleaning keeps, DA the share of the dynamic ones that it drops, AA the root of SA x DA and HA their
harmonic mean (Zhang and others 2023, DynamicMap_Benchmark). There the map points of a cleaned map are looked up in the
truth by distance; here each cleaning marks points of the raw map.

Run as `python -m eval.studies.session_maps PAIR... --out FILE.csv`, where PAIR is a folder of `tunnelcd simulate`. One
row is one session cleaned in one way: by `map.movers` of our maps, and by DUFOMap on the session's own scans.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from cdpipe.core.geometry import BoolArray, Float64Array, transform
from cdpipe.core.plugins import require_extra
from cdpipe.core.threads import THREADS
from cdpipe.core.whole_file import whole_file
from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.movers import find_movers
from cdpipe.methods.dufomap import UNKNOWN_VOXELS, load_dufomap, origin_pose
from cdpipe.methods.whole_map import choose_scans
from cdpipe.model.config import PipelineConfig, load_config
from cdpipe.model.types import PointMap, ScanSource, SessionName
from eval.core.terminal.exits import run_program
from eval.core.terminal.printing import echo
from sim.session.truth import read_labels, read_pair_truth

SESSIONS: tuple[SessionName, SessionName] = ("before", "after")
DYNAMIC_SHARE = 0.5  # of a point's returns
_Clean = Callable[[PointMap, ScanSource, PipelineConfig], BoolArray]


def find_dynamic(point_map: PointMap, session: Path, movers: list[int]) -> BoolArray:
    """Mark the (N,) points of a raw map more than half of whose returns came from movers.

    Args:
        point_map: The map, with the pixel of each return.
        session: The session's folder, with its truth.
        movers: Values of `instance` that are movers'.

    Raises:
        InputError: The session or its truth is missing or damaged.
    """
    opened = read_session(session)
    n_moving, n_all = np.zeros((2, len(point_map.points)), dtype=np.int64)
    scan = 0
    for instances, _ in read_labels(session, opened.n_chunks):
        for instance in instances:
            own = slice(*point_map.scan_offsets[scan : scan + 2])
            points = np.asarray(point_map.return_points[own])
            is_moving = np.isin(instance.ravel()[np.asarray(point_map.return_pixels[own])], movers)
            np.add.at(n_all, points, 1)
            np.add.at(n_moving, points[is_moving], 1)
            scan += 1
    return np.asarray(n_moving > DYNAMIC_SHARE * n_all)


def measure_accuracy(is_dynamic: BoolArray, is_dropped: BoolArray) -> dict[str, float]:
    """Return SA, DA, AA and HA, shares; DA, AA and HA are NaN where nothing is dynamic."""
    static = float((~is_dropped[~is_dynamic]).mean()) if not is_dynamic.all() else np.nan
    dynamic = float(is_dropped[is_dynamic].mean()) if is_dynamic.any() else np.nan
    both = static + dynamic
    harmonic = 2 * static * dynamic / both if both != 0 else 0.0
    return {"SA": static, "DA": dynamic, "AA": float(np.sqrt(static * dynamic)), "HA": harmonic}


def _keep(point_map: PointMap, _source: ScanSource, _config: PipelineConfig) -> BoolArray:
    return np.zeros(len(point_map.points), dtype=np.bool_)


def _drop(point_map: PointMap, _source: ScanSource, _config: PipelineConfig) -> BoolArray:
    if point_map.views is None:
        raise ValueError("views is None")
    return find_movers(point_map.points, point_map.views, point_map.voxel_m)


def _dufomap(point_map: PointMap, source: ScanSource, config: PipelineConfig) -> BoolArray:
    """Mark what DUFOMap finds with the rays of the session's own scans, with the settings of its preset."""
    require_extra("dufomap", "the cleaning dufomap")
    settings = config.dufomap
    void_map = load_dufomap().dufomap(settings.voxel_m, settings.hit_inflation_m, UNKNOWN_VOXELS, THREADS)
    chosen = set(choose_scans(point_map.odom_T_sensor, settings.every_scan).tolist())
    for scan in source.scans():
        if scan.index in chosen:
            odom_T_sensor: Float64Array = point_map.odom_T_sensor[scan.index]
            void_map.run(transform(odom_T_sensor, scan.points_sensor), origin_pose(odom_T_sensor[:3, 3]), False)
    return np.asarray(void_map.segment(point_map.points, origin_pose(np.zeros(3)), False), dtype=np.bool_)


CLEANINGS: dict[str, _Clean] = {"keep": _keep, "map.movers=drop": _drop, "dufomap": _dufomap}


def measure_pair(pair: Path) -> list[dict[str, object]]:
    """Return one row for each session of a pair and each cleaning.

    Raises:
        InputError: The pair or its truth is missing or damaged, or a package is not installed.
    """
    config, rival = load_config("tunnelcd", {"map.movers": "keep"}), load_config("dufomap")
    truth, rows = read_pair_truth(pair), []
    for name in SESSIONS:
        source = open_session(pair / name)
        point_map = build_map(source, config.map)
        movers = [mover.instance for mover in truth.movers if mover.session == name]
        is_dynamic = find_dynamic(point_map, pair / name, movers)
        for cleaning, clean in CLEANINGS.items():
            row: dict[str, object] = {"family": truth.family, "seed": truth.seed, "session": name, "cleaning": cleaning}
            row |= {"n_static": int((~is_dynamic).sum()), "n_dynamic": int(is_dynamic.sum())}
            rows.append(row | measure_accuracy(is_dynamic, clean(point_map, source, rival)))
    return rows


def main(
    pairs: Annotated[list[Path], typer.Argument(help="folders of `tunnelcd simulate`")],
    out: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="the rows", show_default=False)] = None,
) -> None:
    """Print how much of what moved each cleaning drops from a session's own map, and how much of the rest it keeps."""
    table = pd.DataFrame([row for pair in pairs for row in measure_pair(pair)])
    if out is not None:
        with whole_file(out) as path:
            table.to_csv(path, index=False, float_format="%.4g")
    for line in table.to_string(index=False, float_format="{:.3f}".format).splitlines():
        echo(line)


if __name__ == "__main__":
    run_program(main, "eval.studies.session_maps")
