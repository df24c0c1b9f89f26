"""Arguments that several commands share, and what a shell completes for them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer

from cdpipe.core.errors import InputError, ScenarioError
from eval.core.terminal.printing import warn


def _completed(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return what a shell calls: the names that begin as the word does; none where they cannot be told."""

    def complete(incomplete: str) -> list[str]:
        try:
            return [name for name in names() if name.startswith(incomplete)]
        except InputError:
            return []

    return complete


def _scenario_names() -> list[str]:
    from scenarios.catalogue import scenario_names

    return scenario_names()


def _plan_names() -> list[str]:
    from importlib import resources

    from cdpipe.core.plugins import find_yaml

    # as `eval.plans.files` has it, which takes a second to import
    return list(find_yaml("plans", resources.files("eval") / "plans" / "shipped"))


def _preset_names() -> list[str]:
    from cdpipe.model.config import preset_names

    return list(preset_names())


def _method_names() -> list[str]:
    from cdpipe.core.plugins import METHODS, entry_points

    return list(entry_points(METHODS))


def _recording_names() -> list[str]:
    from eval.graft.adapters import list_adapters

    return list(list_adapters())


def _setting_names() -> list[str]:
    from cdpipe.model.config import setting_fields

    return [f"{name}=" for name, _ in setting_fields()]


def _world_names() -> list[str]:
    from cdpipe.core.yamlfile import Settings
    from scenarios.schema import Platform, Scenario, Sensor

    groups: dict[str, type[Settings]] = {"sensor": Sensor, "platform": Platform}
    inner = [f"{name}.{key}=" for name, model in groups.items() for key in model.model_fields]
    return [*inner, *(f"{name}=" for name in Scenario.model_fields if name not in groups)]


def _release_names() -> list[str]:
    from eval.release.names import release_names

    return release_names()


_TO_SIMULATE = "give it to `tunnelcd simulate` by --world"
complete_scenario = _completed(_scenario_names)
complete_plan = _completed(_plan_names)
complete_preset = _completed(_preset_names)
complete_setting = _completed(_setting_names)
complete_method = _completed(lambda: sorted({*_method_names(), *_preset_names()}))
complete_any = _completed(lambda: [*_scenario_names(), *_plan_names(), *_preset_names()])
complete_recording = _completed(_recording_names)
complete_release = _completed(_release_names)
_complete_world = _completed(_world_names)

Families = Annotated[
    list[str],
    typer.Argument(metavar="FAMILY...", help="names from `list`, or .yaml files", autocompletion=complete_scenario),
]
OutFolder = Annotated[Path, typer.Option("--out", help="output folder, new or empty", show_default=False)]
RunOut = Annotated[Path, typer.Option("--out", help="run folder: new, empty, or of an earlier run to continue")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="print no progress and no tables")]
Preset = Annotated[
    str, typer.Option("--preset", help="name of a preset, or a .yaml file", autocompletion=complete_preset)
]
KindOfSite = Annotated[
    Literal["narrow", "wide"],
    typer.Option("--site", help="width of the drifts, for presets with settings for each; `tunnelcd` measures it"),
]
Wide = Annotated[bool, typer.Option("--wide", help="print every column and row, however wide")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON on standard output instead, for programs")]
JsonFile = Annotated[
    Path | None, typer.Option("--out", metavar="FILE", help="also write the JSON to this new file", show_default=False)
]
SetSettings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="one setting; may be repeated", autocompletion=complete_setting),
]
WorldSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--world",
        metavar="KEY=VALUE",
        help="one setting of the world, e.g. sensor.mode=512x10; may be repeated",
        autocompletion=_complete_world,
    ),
]
OldWorldSettings = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", hidden=True)]
Workers = Annotated[int | None, typer.Option(min=1, help="number of processes on this machine", show_default=False)]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="compute on this Dask cluster instead", show_default=False),
]


def join_world_settings(world: Sequence[str] | None, old: Sequence[str] | None) -> list[str]:
    """Return the settings of a world; warn of --set, their old name.

    Raises:
        InputError: One is of a method.
    """
    from cdpipe.model.config import PipelineConfig
    from scenarios.schema import Scenario

    if old:
        warn("--set: settings of the world are given by --world by now; taken as that")
    settings = [*(old or ()), *(world or ())]
    for setting in settings:
        if _group(setting) in PipelineConfig.model_fields.keys() - Scenario.model_fields.keys():
            raise InputError(
                f"--world {setting}: a setting of a method, not of the world: give it to `tunnelcd detect` by --set"
            )
    return settings


def require_method_settings(settings: Sequence[str] | None, way: str = _TO_SIMULATE, option: str = "set") -> None:
    """Refuse settings of a world where those of a method are expected, given by an option.

    Raises:
        InputError: One is of a world.
    """
    from cdpipe.model.config import PipelineConfig
    from scenarios.schema import Scenario

    for setting in settings or ():
        if _group(setting) in Scenario.model_fields.keys() - PipelineConfig.model_fields.keys():
            raise InputError(f"--{option} {setting}: a setting of the world, not of a method: {way}")


@contextmanager
def world_mistakes() -> Iterator[None]:
    """Let mistakes in the settings of a world name the option that they were given by."""
    try:
        yield
    except (ScenarioError, InputError) as error:
        raise type(error)(re.sub(r"^--set\b", "--world", str(error), flags=re.MULTILINE)) from error


def _group(setting: str) -> str:
    return setting.partition("=")[0].partition(".")[0]
