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

from eval.core.exits import run_program
from eval.core.output import make_writable
from eval.studies.reality.plots import draw_measures, draw_novelty, draw_scene
from eval.studies.reality.scenes import (
    as_revolutions,
    cast_at_origin,
    drive_of,
    find_recording,
    real_revolution,
    rebuild,
    with_effects,
)
from eval.studies.reality.sensor_measures import Revolutions
from eval.studies.reality.static_novelty import effect_variants, novelty_cases, static_novelty
from eval.studies.reality.tables import markdown, measured, novelty_table, side_by_side, surface_rows
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
        recast = as_revolutions(real.sensor, scans)
        tables.extend([measured(recast, name), surface_rows(recast, is_surface, name)])
        return recast

    tables = [measured(real, REAL), surface_rows(real, is_surface, REAL)]
    recasts = []
    for name, number in (("", 1), (", 19 sub-rays", 19)):
        settings = Sensor.model_validate({"profile": PROFILE, "max_range_m": _FAR_M, "sub_rays": number})
        recasts.append(cast(f"{SAME_SCENE}{name}", settings, _N_REPEATS))
        tables += [
            measured(_driven(drive, settings), f"{family} {seed}{name}")
            for drive, (family, seed) in zip(drives, WORLDS, strict=True)
        ]
    off = effect_variants(Sensor(profile=PROFILE, max_range_m=_FAR_M))["all off"]
    cast(f"{SAME_SCENE}, effects off", off, 1)  # nothing is random: further revolutions are the same
    first = Revolutions(real.sensor, recasts[0].range_m[:1], recasts[0].signal[:1], recasts[0].reflectivity[:1])
    return first, pd.concat(tables, ignore_index=True)


def _driven(drive: Drive, settings: Sensor) -> Revolutions:
    """Return revolutions spread evenly over a drive."""
    recorded = with_effects(drive, settings)
    numbers = np.linspace(0, recorded.trajectory.n_scans - 1, _N_REPEATS).astype(int).tolist()
    return as_revolutions(recorded.sensor, [cast_revolution(recorded, number)[1] for number in numbers])


def main(
    out: Annotated[Path, typer.Option(help="folder for reality.csv, reality-novelty.csv, their .md and plots")],
    data: Annotated[Path | None, typer.Option(help=f"folder of the real recording [${DATA_VARIABLE}]")] = None,
) -> None:
    """Print and write the comparison."""
    given = os.environ.get(DATA_VARIABLE)
    folder = data or (Path(given) if given else None)
    pcap = find_recording(folder)
    make_writable(out)
    real = real_revolution(pcap)
    drives = [drive_of(family, seed, real.sensor, PROFILE) for family, seed in WORLDS]
    recast, measures = compare(real, drives)
    first = drives[0].trajectory.n_scans // 3
    shares = [(case, static_novelty(drives[0], case, first)) for case in novelty_cases(drives[0].scenario.sensor)]
    novelty = novelty_table(shares)
    text = "\n".join(markdown(table) for table in (side_by_side(measures), novelty))
    measures.to_csv(out / "reality.csv", index=False, float_format="%.5g")
    novelty.to_csv(out / "reality-novelty.csv", index=False, float_format="%.4g")
    (out / "reality.md").write_text(text)
    draw_measures(measures, out / "reality-measures.png")
    draw_scene(real, recast, out / "reality-scene.png")
    draw_novelty(shares, out / "reality-novelty.png")
    typer.echo(text, nl=False)


if __name__ == "__main__":
    run_program(main, "eval.studies.reality.reality")
