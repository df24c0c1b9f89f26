"""What a YAML file of ours is, and whether it has mistakes; nothing is run."""

from __future__ import annotations

from pathlib import Path

from cdpipe.config import load_config, preset_names
from cdpipe.errors import InputError
from cdpipe.yamlfile import read_yaml
from eval.plan import cells, load_plan, plan_names
from scenarios.library import check_scenario, scenario_names


def check_file(name_or_path: str) -> str:
    """Check a scenario, plan or preset, and return which of them it is, in words.

    A file is a plan if it has the key `scenarios`, a scenario if it has `tunnel` or `extends`, and else a preset.

    Raises:
        InputError: It has mistakes, all of them at once; or there is no such thing.
    """
    if name_or_path in plan_names():
        return _plan(name_or_path)
    if name_or_path in scenario_names():
        check_scenario(name_or_path)
        return "a scenario"
    if name_or_path in preset_names():
        load_config(name_or_path)
        return "a preset"
    if not name_or_path.endswith((".yaml", ".yml")):
        raise InputError(f"{name_or_path}: no plan, scenario or preset of this name, and no .yaml file; see `list`")
    content = read_yaml(Path(name_or_path)).value
    keys = set(content) if isinstance(content, dict) else set()
    if "scenarios" in keys:
        return _plan(name_or_path)
    if keys & {"tunnel", "extends"}:
        check_scenario(name_or_path)
        return "a scenario"
    load_config(name_or_path)
    return "a preset"


def _plan(name_or_path: str) -> str:
    n_cells = len(cells(load_plan(name_or_path)))
    return f"a plan of {n_cells} cells"
