"""Second returns of the simulated sensor compared with those of a real one.

python -m eval.studies.reality.second_returns --out reports/sensor [--data FOLDER]

The real revolution is that of an OS0-32 in the dual-return profile, published with the vendor's SDK (BSD-3); it is
looked for below --data or $TUNNELCD_REAL_DATA. The simulator uses the same beam table, `sensor.returns=dual` and seven
sub-rays in three scenes: a surface rebuilt from the first returns of the real revolution, and a narrow and a wide
tunnel of a validation seed, both in clear air.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.io.ouster.captures import open_recording
from cdpipe.sensor.ouster import SensorMetadata
from eval.core.output import make_writable
from eval.core.statistics import mean
from eval.core.terminal.exits import run_program
from eval.report.render import write_file
from eval.studies.reality.reality import DATA_VARIABLE, find_data
from eval.studies.reality.scenes import cast_at_origin, change_effects, find_recording, plan_drive, rebuild
from eval.studies.reality.sensor_measures import Revolutions, destagger, find_edges
from eval.studies.reality.tables import format_markdown
from scenarios.schema import Sensor
from sim.session.revolution import Drive, cast_revolution

RECORDING = "OS-0-32-U1_v2.2.0_1024x10"
PROFILE = "os0-32-nominal"  # the recording's own beam table takes its place
WORLDS = (("narrow", 10001), ("wide", 10001))
JUMP_BINS_M = (1.0, 2.0, 8.0, np.inf)
PERCENTILES = (5, 50, 95)
_N_REPEATS = 10  # revolutions of each simulated source
_FAR_M = 250.0


@dataclass(frozen=True, slots=True, eq=False)
class DualReturns:
    """Both returns of some revolutions, destaggered.

    Attributes:
        first: The stronger return of each beam.
        second: The weaker one.
    """

    first: Revolutions
    second: Revolutions

    @property
    def has_both(self) -> BoolArray:
        """(N, H, W) mask of the beams with two returns."""
        return self.first.is_return & self.second.is_return


def split_returns(sensor: SensorMetadata, images: Sequence[Float64Array]) -> DualReturns:
    """Split images whose second returns follow the first ones.

    Args:
        sensor: Of both returns.
        images: Range in metres, signal and reflectivity, each (N, 2 H, W), staggered.
    """
    halves = ([destagger(sensor, half) for half in np.split(image, 2, axis=-2)] for image in images)
    first, second = zip(*halves, strict=True)
    return DualReturns(Revolutions(sensor, *first), Revolutions(sensor, *second))


def read_real_returns(pcap: Path) -> DualReturns:
    """Read the first revolution of a capture with two returns.

    Raises:
        InputError: The extra `ouster` is not installed, or the capture is damaged or holds no whole revolution.
    """
    recording = open_recording(pcap)
    return _gather(recording.sensor, [next(recording.revolutions())])


def tabulate_second_returns(returns: DualReturns, source: str) -> pd.DataFrame:
    """Return a table with one row per figure: figure, value (NaN where nothing counts), n (beams counted), source."""
    return pd.DataFrame(_list_figures(returns), columns=["figure", "value", "n"]).assign(source=source)


def _list_figures(returns: DualReturns) -> Iterator[tuple[str, float, int]]:
    has_both, is_first = returns.has_both, returns.first.is_return
    yield "beams with a second return, of those with a first", mean(has_both[is_first]), int(is_first.sum())
    behind_m = (returns.second.range_m - returns.first.range_m)[has_both]
    yield "of these, the second lies behind the first", mean(behind_m > 0), len(behind_m)
    is_stronger = returns.second.signal[has_both] > returns.first.signal[has_both]
    yield "of these, the second is stronger", mean(is_stronger), len(is_stronger)
    ratio = returns.second.signal[has_both] / np.maximum(returns.first.signal[has_both], 1.0)
    yield "signal of the second by that of the first, median", _percentile(ratio, 50), len(ratio)
    jump_m = np.nan_to_num(find_edges(returns.first)[0])
    for low, high in pairwise(JUMP_BINS_M):
        where = is_first & (jump_m >= low) & (jump_m < high)
        name = f"at a jump of {low:g} m or more" if np.isinf(high) else f"at a jump of {low:g} to {high:g} m"
        yield f"beams with a second return, {name}", mean(has_both[where]), int(where.sum())
    for percent in PERCENTILES:
        name = f"distance between both returns, {percent}th percentile, m"
        yield name, _percentile(np.abs(behind_m), percent), len(behind_m)


def _percentile(values: Float64Array, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def _gather(sensor: SensorMetadata, revolutions: Sequence[object]) -> DualReturns:
    images = [
        np.stack([getattr(each, name) for each in revolutions]).astype(np.float64)
        for name in ("range_mm", "signal", "reflectivity")
    ]
    return split_returns(sensor, [images[0] / 1000.0, *images[1:]])


def _cast_along(drive: Drive, settings: Sensor) -> DualReturns:
    recorded = change_effects(drive, settings)
    numbers = np.linspace(0, recorded.trajectory.n_scans - 1, _N_REPEATS).astype(int).tolist()
    return _gather(recorded.sensor, [cast_revolution(recorded, number)[1] for number in numbers])


def compare(real: DualReturns, drives: Sequence[Drive]) -> pd.DataFrame:
    """Return the figures of the recording and of the simulator: rows of `tabulate_second_returns`.

    Args:
        real: The recording.
        drives: Drives through `WORLDS`, with the sensor of the recording.
    """
    sensor = real.first.sensor
    settings = Sensor.model_validate({"profile": PROFILE, "max_range_m": _FAR_M, "sub_rays": 7, "returns": "dual"})
    scene, _ = rebuild(real.first, drives[0].scene)
    rebuilt = _gather(sensor, [cast_at_origin(scene, sensor, settings, number) for number in range(_N_REPEATS)])
    simulated = {
        f"{family} {seed}": _cast_along(drive, settings) for drive, (family, seed) in zip(drives, WORLDS, strict=True)
    }
    sources = {"real": real, "real scene": rebuilt} | simulated
    return pd.concat([tabulate_second_returns(each, name) for name, each in sources.items()], ignore_index=True)


def arrange_by_source(table: pd.DataFrame) -> pd.DataFrame:
    """Return the figures with one column per source."""
    wide = table.pivot_table(index="figure", columns="source", values="value", sort=False, dropna=False)
    return wide[list(dict.fromkeys(table["source"]))].reset_index()


def main(
    out: Annotated[Path, typer.Option(help="folder for second-returns.csv")],
    data: Annotated[Path | None, typer.Option(help=f"folder of the real recording [${DATA_VARIABLE}]")] = None,
) -> None:
    """Print and write the comparison."""
    pcap = find_recording(find_data(data), RECORDING)
    make_writable(out)
    real = read_real_returns(pcap)
    drives = [plan_drive(family, seed, real.first.sensor, PROFILE) for family, seed in WORLDS]
    table = compare(real, drives)
    write_file(out / "second-returns.csv", table.to_csv(index=False, float_format="%.5g"))
    typer.echo(format_markdown(arrange_by_source(table)), nl=False)


if __name__ == "__main__":
    run_program(main, "eval.studies.reality.second_returns")
