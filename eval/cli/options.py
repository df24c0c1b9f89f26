"""Arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Families = Annotated[list[str], typer.Argument(metavar="FAMILY...", help="names from `list`, or .yaml files")]
OutFolder = Annotated[Path, typer.Option("--out", help="output folder, new or empty", show_default=False)]
RunOut = Annotated[Path, typer.Option("--out", help="run folder: new, empty, or of an earlier run to continue")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="print no progress and no tables")]
Preset = Annotated[str, typer.Option("--preset", help="name of a preset, or a .yaml file")]
KindOfSite = Annotated[
    Literal["narrow", "wide"],
    typer.Option("--site", help="width of the drifts, for presets with settings for each; `tunnelcd` measures it"),
]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON on standard output instead, for programs")]
SetSettings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="one setting; may be repeated")
]
Workers = Annotated[int | None, typer.Option(min=1, help="number of processes on this machine", show_default=False)]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="compute on this Dask cluster instead", show_default=False),
]
