"""What `tunnelcd view` is asked to show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import suggest
from cdpipe.io.session import is_session
from scenarios import load_scenario, scenario_names
from scenarios.library import SUFFIXES
from sim.view.view import View, is_pair, view_folder, view_scenario


def view_of(what: str, seed: int | None = None, settings: Sequence[str] = ()) -> View:
    """Return the view of a scenario (name or YAML file), of a simulated pair, or of a session.

    Args:
        what: Name, file or folder; a name of `scenario_names()` wins over a folder that holds nothing to show.
        seed: Of a scenario; 0 if None. A folder has its own.
        settings: `a.b=value` pairs written over a scenario.

    Raises:
        InputError: There is no such thing, it is damaged, or a seed or a setting is given for a folder.
        ScenarioError: The scenario has mistakes, or its world cannot be built.
    """
    path, names = Path(what), scenario_names()
    if is_pair(path) or is_session(path) or (path.is_dir() and what not in names):
        if seed is not None or settings:
            raise InputError(f"{what}: a folder shows what was recorded: leave --seed and --set out")
        return view_folder(path)
    if what not in names and path.suffix not in SUFFIXES:
        hint = suggest(what, names) or "; `tunnelcd list` names the scenarios"
        raise InputError(f"{what}: neither a folder nor a scenario{hint}")
    return view_scenario(load_scenario(what, seed or 0, settings), seed or 0)
