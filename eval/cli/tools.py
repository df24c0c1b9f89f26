"""Commands about the installation: its speed, what it ships, and whether files are right."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eval.cli.options import Quiet
from eval.core.printing import MET, print_table


def bench(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json", help="also write the table", show_default=False)
    ] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="this row alone; repeatable")] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the speed table, each figure beside its rival in the same run. A missed target is told, not an error."""
    import pandas as pd

    from eval.bench.bench import chosen, contests, make_ready, measure, reasons, verdict, write_table
    from eval.core.progress import Lines, Silent

    rows = chosen(contests(), only or ())
    if out is not None:
        make_ready(out)
    # lines, never bars: a thread that redraws them would be measured too
    table = measure(rows, (Silent() if quiet else Lines()).cells)
    if out is not None:
        write_table(table, out)
    if quiet:
        return
    shown = pd.DataFrame(table["rows"]).assign(met=[MET[row["met"]] for row in table["rows"]]).drop(columns="reason")
    cpu, cores = table["machine"]["cpu"], table["machine"]["cores"]
    print_table(f"speed, {cpu}, {cores} cores; ratio: times faster than the rival", shown)
    for line in reasons(table["rows"]):
        typer.echo(line)
    typer.echo(f"{verdict(table['rows'])}{'' if out is None else f'; {out}'}")


def list_command() -> None:
    """Name the scenarios, props, plans, presets and sensor profiles there are."""
    from cdpipe.core.plugins import METHODS, METRICS, entry_points
    from cdpipe.model.config import preset_names
    from cdpipe.sensor.ouster import profile_names
    from eval.plans.plan import plan_names
    from scenarios import prop_names, scenario_names

    groups = {
        "scenarios": scenario_names(),
        "props": prop_names(),
        "plans": plan_names(),
        "presets": preset_names(),
        "methods": list(entry_points(METHODS)),
        "metrics of plugins": list(entry_points(METRICS)),
        "sensor profiles": profile_names(),
    }
    for title, names in groups.items():
        typer.echo(f"{title}:")
        for name in names:
            typer.echo(f"  {name}")


def doctor() -> None:
    """Tell what is installed, whether it works, and what mends it where it does not."""
    from cdpipe.core.errors import InputError
    from eval.cli.doctor import examine, faults

    found = []
    for each in examine():
        found.append(each)
        typer.echo(f"{each.what:<15} {each.state:<7} {each.told}")
    if wrong := faults(found):
        raise InputError("\n".join(wrong))
    typer.echo("all that is required works")


def check(files: Annotated[list[str], typer.Argument(help="scenario, plan or preset: a name or a .yaml file")]) -> None:
    """Validate scenarios, plans and presets without running anything."""
    from cdpipe.core.errors import InputError
    from eval.cli.checking import check_file

    mistakes: list[str] = []
    for file in files:
        try:
            typer.echo(f"{file}: {check_file(file)}, no mistakes")
        except InputError as error:
            mistakes += str(error).splitlines()
    if mistakes:
        raise InputError("\n".join(mistakes))
