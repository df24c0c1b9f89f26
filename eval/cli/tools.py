"""Commands about the installation: its speed, what it holds, and whether files are valid."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from eval.cli.options import AsJson, Quiet
from eval.cli.printed_answer import LINE
from eval.core.printing import MET, echo, echo_json, line_width, print_table


def bench(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json", help="also write the table", show_default=False)
    ] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="this row only; may be repeated")] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the speed table, each figure beside its rival in the same run. A missed target is not an error."""
    import pandas as pd

    from eval.bench.bench import choose, list_contests, list_reasons, measure, require_writable, summarise, write_table
    from eval.core.progress import Lines, Silent

    rows = choose(list_contests(), only or ())
    if out is not None:
        require_writable(out)
    # lines, never bars: the time of a thread that redraws bars would be measured as well
    table = measure(rows, (Silent() if quiet else Lines()).cells)
    if out is not None:
        write_table(table, out)
    if quiet:
        return
    shown = pd.DataFrame(table["rows"]).assign(met=[MET[row["met"]] for row in table["rows"]]).drop(columns="reason")
    cpu, cores = table["machine"]["cpu"], table["machine"]["cores"]
    print_table(f"speed, {cpu}, {cores} cores; ratio: times faster than the rival", shown)
    for line in list_reasons(table["rows"]):
        echo(line)
    echo(f"{summarise(table['rows'])}{'' if out is None else f'; {out}'}")


def list_command(
    what: Annotated[
        Literal["scenarios", "props", "plans", "presets", "methods", "metrics", "sensors", "settings"] | None,
        typer.Argument(help="this alone, with one-line descriptions; of settings with default and unit"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List scenarios, props, plans, presets, methods, metrics, sensors; or one of these, or the settings, described."""
    from dataclasses import asdict

    from eval.cli.listing import describe_entry, describe_setting, list_entries

    if what is None:
        names = {title: [entry.name for entry in list_entries(kind)] for kind, title in _TITLES.items()}
        if as_json:
            echo_json({kind: names[title] for kind, title in _TITLES.items()})
            return
        for title, of_kind in names.items():
            echo(f"{title}:", *(f"  {name}" for name in of_kind))
        return
    columns = ["name", "default", "unit", "description"] if what == "settings" else ["name", "description"]
    entries = list_entries(what)
    if as_json:
        echo_json([{column: asdict(entry)[column] for column in columns} for entry in entries])
        return
    for entry in entries:
        echo(*(describe_setting(entry, LINE) if what == "settings" else [describe_entry(entry, entries, line_width())]))


_TITLES = {
    "scenarios": "scenarios",
    "props": "props",
    "plans": "plans",
    "presets": "presets",
    "methods": "methods",
    "metrics": "metrics of plugins",
    "sensors": "sensor profiles",
}


def doctor(as_json: AsJson = False) -> None:
    """Print what is installed, whether it works, and how to repair what does not."""
    from dataclasses import asdict

    from cdpipe.core.errors import InputError
    from eval.cli.doctor import examine, faults

    found = []
    for each in examine():
        found.append(each)
        if not as_json:
            echo(f"{each.what:<15} {each.state:<7} {each.told}")
    if as_json:
        echo_json([asdict(each) for each in found])
    if wrong := faults(found):
        raise InputError("\n".join(wrong))
    if not as_json:
        echo("all that is required works")


def check(
    files: Annotated[list[str], typer.Argument(help="scenario, plan or preset: a name or a .yaml file")],
    as_json: AsJson = False,
) -> None:
    """Validate scenarios, plans and presets without running anything."""
    from cdpipe.core.errors import InputError

    mistakes: list[str] = []
    rows: list[dict[str, object]] = []
    for file in files:
        found, own = "", []
        try:
            found = check_file(file)
        except InputError as error:
            own = str(error).split("\n")
        mistakes += own
        rows.append({"file": file, "is": found or None, "mistakes": own})
        if found and not as_json:
            echo(f"{file}: {found}, no mistakes")
    if as_json:
        echo_json(rows)
    if mistakes:
        raise InputError("\n".join(mistakes))


def check_file(name_or_path: str) -> str:
    """Check a scenario, plan or preset, and return its kind in words.

    A file is of the kind with which it shares most keys, so that one misspelt key does not change its kind.

    Raises:
        InputError: It has mistakes (all of them at once), or it does not exist.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.core.yamlfile import read_yaml, suggest
    from cdpipe.model.config import PipelineConfig, load_config, preset_names
    from eval.plans.files import plan_names
    from eval.plans.plan import Plan, expand_cells, load_plan
    from scenarios import check_scenario, scenario_names
    from scenarios.schema import Scenario

    names = {"plan": plan_names(), "scenario": scenario_names(), "preset": preset_names()}
    kind = next((kind for kind, known in names.items() if name_or_path in known), "")
    if not kind:
        if not name_or_path.endswith((".yaml", ".yml")):
            near = suggest(name_or_path, [name for known in names.values() for name in known])
            raise InputError(
                f"{name_or_path}: no plan, scenario or preset of this name, and no .yaml file{near or '; see `list`'}"
            )
        keys = {
            "preset": {*PipelineConfig.model_fields, "wide"},
            "plan": set(Plan.model_fields),
            "scenario": {*Scenario.model_fields, "extends", "frozen"},
        }
        content = read_yaml(Path(name_or_path)).value
        own = set(content) if isinstance(content, dict) else set()
        kind = max(keys, key=lambda name: len(own & keys[name]))
    if kind == "plan":
        return f"a plan of {len(expand_cells(load_plan(name_or_path)))} cells"
    if kind == "scenario":
        check_scenario(name_or_path)
    else:
        load_config(name_or_path)
    return f"a {kind}"
