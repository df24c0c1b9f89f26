"""The simulated sensor compared with a real one: returns, range noise, signal, false and mixed returns, novelty.

python -m eval.studies.reality.reality --out reports/sensor [--data FOLDER]

The real revolution is that of an OS1-32 gradient unit, published with the vendor's SDK (BSD-3); it is looked for below
--data or $TUNNELCD_REAL_DATA. The simulator uses the same beam table in three scenes: a surface rebuilt from the real
revolution, and a narrow and a wide tunnel of a validation seed. The rebuilt scene with every effect off shows what the
rebuilding itself adds.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from eval.core.output import make_writable
from eval.core.terminal.exits import run_program
from eval.report.render import write_file
from eval.studies.reality.plots import draw_measures, draw_novelty, draw_scene
from eval.studies.reality.scenes import (
    cast_at_origin,
    change_effects,
    find_recording,
    gather_revolutions,
    plan_drive,
    read_real_revolution,
    rebuild,
)
from eval.studies.reality.sensor_measures import Revolutions
from eval.studies.reality.static_novelty import list_effect_variants, list_novelty_cases, measure_static_novelty
from eval.studies.reality.tables import (
    arrange_by_source,
    format_markdown,
    tabulate_measures,
    tabulate_novelty,
    tabulate_surface,
)
from scenarios.schema import Sensor
from sim.session.revolution import Drive, cast_revolution

DATA_VARIABLE = "TUNNELCD_REAL_DATA"
PROFILE = "os1-32-g"
WORLDS = (("narrow", 10000), ("wide", 10000))
REAL, SAME_SCENE = "real", "real scene"
_N_REPEATS = 10  # revolutions of each simulated source
# The real unit reports returns to 204 m; a tunnel has none so far.
_FAR_M = 250.0


def compare(real: Revolutions, drives: Sequence[Drive]) -> tuple[Revolutions, pd.DataFrame]:
    """Measure the recording and the simulator by the same definitions.

    Args:
        real: The recording.
        drives: Drives through `WORLDS`, with the sensor of the recording.

    Returns:
        One revolution simulated in the scene rebuilt from the recording, with default effects; the table of
        `eval.studies.reality.tables.COLUMNS`.
    """
    scene, is_surface = rebuild(real, drives[0].scene)

    def cast(name: str, settings: Sensor, n_revolutions: int) -> Revolutions:
        scans = [cast_at_origin(scene, real.sensor, settings, number) for number in range(n_revolutions)]
        recast = gather_revolutions(real.sensor, scans)
        tables.extend([tabulate_measures(recast, name), tabulate_surface(recast, is_surface, name)])
        return recast

    tables = [tabulate_measures(real, REAL), tabulate_surface(real, is_surface, REAL)]
    recasts = []
    for name, number in (("", 1), (", 19 sub-rays", 19)):
        settings = Sensor.model_validate({"profile": PROFILE, "max_range_m": _FAR_M, "sub_rays": number})
        recasts.append(cast(f"{SAME_SCENE}{name}", settings, _N_REPEATS))
        tables += [
            tabulate_measures(_cast_along(drive, settings), f"{family} {seed}{name}")
            for drive, (family, seed) in zip(drives, WORLDS, strict=True)
        ]
    off = list_effect_variants(Sensor(profile=PROFILE, max_range_m=_FAR_M))["all off"]
    cast(f"{SAME_SCENE}, effects off", off, 1)  # nothing is random: further revolutions are the same
    first = Revolutions(real.sensor, recasts[0].range_m[:1], recasts[0].signal[:1], recasts[0].reflectivity[:1])
    return first, pd.concat(tables, ignore_index=True)


def _cast_along(drive: Drive, settings: Sensor) -> Revolutions:
    """Return revolutions spread evenly over a drive."""
    recorded = change_effects(drive, settings)
    numbers = np.linspace(0, recorded.trajectory.n_scans - 1, _N_REPEATS).astype(int).tolist()
    return gather_revolutions(recorded.sensor, [cast_revolution(recorded, number)[1] for number in numbers])


def find_data(given: Path | None) -> Path | None:
    """Return the folder of real recordings: the given one, else that of `DATA_VARIABLE`, else None."""
    told = os.environ.get(DATA_VARIABLE)
    return given or (Path(told) if told else None)


def main(
    out: Annotated[Path, typer.Option(help="folder for reality.csv, reality-novelty.csv, their .md and plots")],
    data: Annotated[Path | None, typer.Option(help=f"folder of the real recording [${DATA_VARIABLE}]")] = None,
) -> None:
    """Print and write the comparison."""
    pcap = find_recording(find_data(data))
    make_writable(out)
    real = read_real_revolution(pcap)
    drives = [plan_drive(family, seed, real.sensor, PROFILE) for family, seed in WORLDS]
    recast, measures = compare(real, drives)
    first = drives[0].trajectory.n_scans // 3
    shares = [
        (case, measure_static_novelty(drives[0], case, first)) for case in list_novelty_cases(drives[0].scenario.sensor)
    ]
    novelty = tabulate_novelty(shares)
    text = "\n".join(format_markdown(table) for table in (arrange_by_source(measures), novelty))
    write_file(out / "reality.csv", measures.to_csv(index=False, float_format="%.5g"))
    write_file(out / "reality-novelty.csv", novelty.to_csv(index=False, float_format="%.4g"))
    write_file(out / "reality.md", text)
    draw_measures(measures, out / "reality-measures.png")
    draw_scene(real, recast, out / "reality-scene.png")
    draw_novelty(shares, out / "reality-novelty.png")
    typer.echo(text, nl=False)


if __name__ == "__main__":
    run_program(main, "eval.studies.reality.reality")
