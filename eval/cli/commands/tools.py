"""Commands about the installation: its speed, what it holds, and whether files are valid."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from eval.cli.options import AsJson, JsonFile, Quiet, complete_any
from eval.core.terminal.printing import (
    LINE,
    MET,
    echo,
    echo_wrapped,
    line_width,
    print_fitted,
    require_json_file,
    tell_json,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from scenarios.schema import Scenario

_SPEED_GIVES_WAY = (("n", "spread"), ("rival_value",), ("rival",))
_GROWTH_GIVES_WAY = (("peak_mb", "wall_s"), ("smallest", "first"), ("largest", "last"))
_DECIMALS_OF_EXPONENTS = {"exponent": 2, "low": 2, "high": 2, "last": 2}


def bench(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json", help="also write the table", show_default=False)
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="this row, axis or scenario only; may be repeated")
    ] = None,
    growth: Annotated[
        bool, typer.Option("--growth", help="how time and memory grow with the input; also FILE.csv and FILE.png")
    ] = False,
    profile: Annotated[
        bool, typer.Option("--profile", help="where the time of both paper sites goes, by stage; also FILE.md")
    ] = False,
    surface: Annotated[
        bool, typer.Option("--surface", help="with --profile: displacement of the rock as well")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="with --growth: sizes that show only that it runs")] = False,
    large: Annotated[bool, typer.Option("--large", help="with --growth: up to 5 million points")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure the speed table, each figure beside its rival in the same run. A missed target is not an error."""
    from eval.bench.bench import choose, list_contests, measure, require_writable
    from eval.bench.growth import choose_axes, measure_growth, write_growth
    from eval.bench.profile import SITES, measure_profile, write_markdown
    from eval.core.terminal.progress import Lines, Silent

    _require_one_table(growth=growth, profile=profile, surface=surface, quick=quick, large=large)
    contests = choose(list_contests(), only or ()) if not growth and not profile else {}
    axes = choose_axes(only or ()) if growth else []
    if out is not None:
        require_writable(out, growth=growth, profile=profile)
    # lines, never bars: the time of a thread that redraws bars would be measured as well
    tell = (Silent() if quiet else Lines()).cells
    written: list[Path] = []
    if growth:
        table = measure_growth(axes, quick=quick, large=large, on_progress=tell)
        written = [] if out is None else write_growth(table, out)
    elif profile:
        table = measure_profile(only or SITES, has_surface=surface, on_progress=tell)
        written = [] if out is None else [write_markdown(table, out)]
    else:
        table = measure(contests, tell)
    written = [*([] if out is None else [out]), *written]
    tell_json(table, as_json=as_json, file=out)
    show = _print_growth if growth else _print_profile if profile else _print_speed
    if not quiet and not as_json:
        show(table, written)


def _require_one_table(*, growth: bool, profile: bool, surface: bool, quick: bool, large: bool) -> None:
    """Refuse options of a table that is not asked for.

    Raises:
        InputError: Which one.
    """
    from cdpipe.core.errors import InputError

    if growth and profile:
        raise InputError("--growth and --profile: two tables: ask for one at a time")
    if quick and large:
        raise InputError("--quick and --large: name one of both")
    for is_given, name, needed, needs in ((quick, "quick", growth, "growth"), (large, "large", growth, "growth"),
                                          (surface, "surface", profile, "profile")):  # fmt: skip
        if is_given and not needed:
            raise InputError(f"--{name}: belongs to --{needs}: add it, or leave --{name} out")


def _print_speed(table: dict[str, Any], written: list[Path]) -> None:
    from eval.bench.bench import list_reasons, summarise

    rows = _with_units(table["rows"])
    shown = rows.assign(met=rows["met"].map(MET.get)).drop(columns="reason")
    _print_fitted(f"speed, {_machine(table)}; ratio: times faster than the rival", shown, _SPEED_GIVES_WAY)
    for line in [*list_reasons(table["rows"]), summarise(table["rows"])]:
        echo_wrapped(line, LINE)
    _tell_files(written)


def _print_growth(table: dict[str, Any], written: list[Path]) -> None:
    from eval.bench.growth import summarise_growth

    shown = _with_units(table["rows"]).drop(columns=["grows", "n"])
    title = f"growth, {_machine(table)}; figure = c * size ** exponent (low, high: 95 %)"
    _print_fitted(title, shown.round(_DECIMALS_OF_EXPONENTS), _GROWTH_GIVES_WAY)
    echo_wrapped(summarise_growth(table), LINE)
    _tell_files(written)


def _print_profile(table: dict[str, Any], written: list[Path]) -> None:
    import pandas as pd

    _print_fitted(f"profile, {_machine(table)}; share: of the command's CPU time", pd.DataFrame(table["rows"]))
    _tell_files(written)


def _print_fitted(title: str, table: pd.DataFrame, gives_way: Sequence[Sequence[str]] = ()) -> None:
    left_out = print_fitted(title, table, gives_way)
    if left_out:
        echo_wrapped(f"left out: {', '.join(left_out)}; --json and --out FILE.json have all", LINE)


def _with_units(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the rows with the unit in the cell of the value, of three digits."""
    import pandas as pd

    values = [math.nan if row["value"] is None else float(row["value"]) for row in rows]
    told = ["-" if math.isnan(value) else f"{value:.3g} {row['unit']}" for value, row in zip(values, rows, strict=True)]
    return pd.DataFrame(rows).assign(value=told).drop(columns="unit")


def _machine(table: dict[str, Any]) -> str:
    return f"{table['machine']['cpu']}, {table['machine']['cores']} cores"


def _tell_files(written: list[Path]) -> None:
    echo(*(f"written: {file}" for file in written))


def list_command(
    what: Annotated[
        Literal[
            "scenarios", "props", "plans", "presets", "methods", "metrics", "sensors", "recordings", "settings", "world"
        ]
        | None,
        typer.Argument(help="this alone, described; settings, and world: keys of --world, with default and unit"),
    ] = None,
    as_json: AsJson = False,
    out: JsonFile = None,
) -> None:
    """List scenarios, props, plans, presets, methods, metrics, sensors; one of these, settings, or keys of --world."""
    from dataclasses import asdict

    from eval.cli.listing import WITH_DEFAULTS, describe_entry, describe_setting, list_entries

    require_json_file(out)
    if what is None:
        names = {title: [entry.name for entry in list_entries(kind)] for kind, title in _TITLES.items()}
        tell_json({kind: names[title] for kind, title in _TITLES.items()}, as_json=as_json, file=out)
        if as_json:
            return
        for title, of_kind in names.items():
            echo(f"{title}:", *(f"  {name}" for name in of_kind))
        return
    has_defaults = what in WITH_DEFAULTS
    columns = ["name", "default", "unit", "description"] if has_defaults else ["name", "description"]
    entries = list_entries(what)
    tell_json([{column: asdict(entry)[column] for column in columns} for entry in entries], as_json=as_json, file=out)
    if as_json:
        return
    for entry in entries:
        echo(*(describe_setting(entry, LINE) if has_defaults else [describe_entry(entry, entries, line_width())]))


_TITLES = {
    "scenarios": "scenarios",
    "props": "props",
    "plans": "plans",
    "presets": "presets",
    "methods": "methods",
    "metrics": "metrics",
    "sensors": "sensor profiles",
    "recordings": "public recordings",
}


def doctor(as_json: AsJson = False, out: JsonFile = None) -> None:
    """Print what is installed, whether it works, and how to repair what does not."""
    from dataclasses import asdict

    from cdpipe.core.errors import InputError
    from eval.cli.doctor import examine, faults

    require_json_file(out)
    found = []
    for each in examine():
        found.append(each)
        if not as_json:
            echo(f"{each.what:<15} {each.state:<7} {each.told}")
    tell_json([asdict(each) for each in found], as_json=as_json, file=out)
    if wrong := faults(found):
        raise InputError("\n".join(wrong))
    if not as_json:
        echo("all that is required works")


def check(
    files: Annotated[
        list[str], typer.Argument(help="scenario, plan or preset: a name or a .yaml file", autocompletion=complete_any)
    ],
    as_json: AsJson = False,
    out: JsonFile = None,
) -> None:
    """Validate scenarios, plans and presets without running anything."""
    from cdpipe.core.errors import InputError
    from cdpipe.core.names import visible

    require_json_file(out)
    mistakes: list[str] = []
    rows: list[dict[str, object]] = []
    for file in files:
        found, own = "", []
        try:
            found = check_file(file)
        except InputError as error:
            own = str(error).replace(file, visible(file)).split("\n")  # the name may have a line break
        mistakes += own
        rows.append({"file": file, "is": found or None, "mistakes": own})
        if found and not as_json:
            echo(f"{file}: {found}, no mistakes")
    tell_json(rows, as_json=as_json, file=out)
    if mistakes:
        raise InputError("\n".join(mistakes))


def check_file(name_or_path: str) -> str:
    """Check a scenario, the meshes it names, a plan or a preset, and return its kind in words.

    A file is of the kind with which it shares most keys, so that one misspelt key does not change its kind.

    Raises:
        InputError: It has mistakes (all of them at once), or it does not exist.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.core.yamlfile import read_yaml, suggest
    from cdpipe.model.config import PipelineConfig, load_config, preset_names
    from eval.plans.cells import expand_cells
    from eval.plans.files import plan_names
    from eval.plans.plan import Plan, load_plan
    from scenarios import check_scenario, scenario_names
    from scenarios.library import CHECKED_SEEDS, load_grafted, load_scenario
    from scenarios.schema import Scenario

    names = {"plan": plan_names(), "scenario": scenario_names(), "preset": preset_names()}
    kind = next((kind for kind, known in names.items() if name_or_path in known), "")
    if not kind:
        if not name_or_path.endswith((".yaml", ".yml")):
            near = suggest(name_or_path, [name for known in names.values() for name in known])
            raise InputError(
                f"{name_or_path}: no plan, scenario or preset of this name, and no .yaml file{near or '; see `list`'}"
            )
        if not Path(name_or_path).exists():
            raise InputError(f"{name_or_path}: no such file: expected a plan, a scenario or a preset in YAML")
        keys = {
            "preset": {*PipelineConfig.model_fields, "wide"},
            "plan": set(Plan.model_fields),
            "scenario": {*Scenario.model_fields, "extends", "frozen"},
        }
        content = read_yaml(Path(name_or_path)).value
        own = set(content) if isinstance(content, dict) else set()
        if own & {"props", "surface"} and not own & {"tunnel", "extends", "recording"}:
            # any file may stand for the recording
            drawn = [load_grafted(name_or_path, {"sessions": [name_or_path]}, seed) for seed in CHECKED_SEEDS]
            _open_meshes(name_or_path, drawn)
            return "a file of props and rock for `graft --objects`"
        kind = max(keys, key=lambda name: len(own & keys[name]))
    if kind == "plan":
        return f"a plan of {len(expand_cells(load_plan(name_or_path)))} cells"
    if kind == "scenario":
        check_scenario(name_or_path)
        worlds = {seed: load_scenario(name_or_path, seed) for seed in CHECKED_SEEDS}
        _open_meshes(name_or_path, [*worlds.values()])
        _require_sizes(name_or_path, worlds)
    else:
        load_config(name_or_path)
    return f"a {kind}"


def _require_sizes(scenario: str, drawn: Mapping[int, Scenario]) -> None:
    """Refuse a scenario of which one of the checked seeds draws a world that is too large to be built.

    Raises:
        ScenarioError: It does: one line, of the first such seed.
    """
    from cdpipe.core.errors import ScenarioError
    from scenarios.grafted import GraftScenario
    from sim.rock.centreline import build_centreline
    from sim.size import require_size

    for seed, each in drawn.items():
        if isinstance(each, GraftScenario):
            continue
        try:
            centreline = build_centreline(each.tunnel, seed)
        except ScenarioError:
            continue  # a world of this seed alone, which becomes a row of a run
        try:
            require_size(each, centreline)
        except ScenarioError as error:
            raise ScenarioError(f"{scenario}: seed {seed}: {error}") from error


def _open_meshes(scenario: str, drawn: Sequence[Scenario]) -> None:
    """Read every mesh that a scenario names as drawn for one of the checked seeds, as `simulate` reads it.

    Raises:
        ScenarioError: Some cannot be used: one line each.
    """
    from cdpipe.core.errors import ScenarioError
    from scenarios.grafted import GraftScenario
    from sim.rock.foreign import prop_mesh, tunnel_mesh

    simulated = [each for each in drawn if not isinstance(each, GraftScenario)]  # the walls of the others are recorded
    tunnels = dict.fromkeys(each.tunnel.mesh for each in simulated if each.tunnel.mesh)
    props = dict.fromkeys((prop.mesh, prop.name) for each in drawn for prop in each.props if prop.mesh)
    mistakes = []
    for read in [*(partial(tunnel_mesh, mesh) for mesh in tunnels), *(partial(prop_mesh, *prop) for prop in props)]:
        try:
            read()
        except ScenarioError as error:
            mistakes.append(f"{scenario}: {error}")
    if mistakes:
        raise ScenarioError("\n".join(mistakes))
