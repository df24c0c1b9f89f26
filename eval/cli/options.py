"""Arguments that several commands share."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

import typer

OutFolder = Annotated[Path, typer.Option("--out", help="output folder, new or empty", show_default=False)]
RunOut = Annotated[Path, typer.Option("--out", help="run folder: new, empty, or to be continued", show_default=False)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress, no tables")]
Preset = Annotated[str, typer.Option("--preset", help="shipped preset, or a .yaml file")]
KindOfSite = Annotated[
    Literal["narrow", "wide"],
    typer.Option("--site", help="which drifts: what the preset says of narrow or of wide ones"),
]
SetSettings = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="a setting; repeatable")]


class ShownViews(Enum):
    """Which pairs of a run get a 3-D view (`eval.report.site.views.Views`)."""

    chosen = "chosen"
    none = "none"
    all = "all"
