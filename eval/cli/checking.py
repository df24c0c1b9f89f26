"""What a YAML file of ours is, and whether it has mistakes; nothing is run."""

from __future__ import annotations

from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import read_yaml, suggest
from cdpipe.model.config import PipelineConfig, load_config, preset_names
from eval.plans.plan import Plan, cells, load_plan, plan_names
from scenarios import check_scenario, scenario_names
from scenarios.schema import Scenario

_KEYS = {
    "preset": {*PipelineConfig.model_fields, "wide"},
    "plan": set(Plan.model_fields),
    "scenario": {*Scenario.model_fields, "extends", "frozen"},
}


def check_file(name_or_path: str) -> str:
    """Check a scenario, plan or preset, and return which of them it is, in words.

    A file is taken for the kind with which it shares most keys, so that one misspelt key does not change what it is.

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
        near = suggest(name_or_path, [*plan_names(), *scenario_names(), *preset_names()])
        raise InputError(
            f"{name_or_path}: no plan, scenario or preset of this name, and no .yaml file{near or '; see `list`'}"
        )
    content = read_yaml(Path(name_or_path)).value
    keys = set(content) if isinstance(content, dict) else set()
    n_shared = {kind: len(keys & known) for kind, known in _KEYS.items()}
    kind = max(n_shared, key=lambda name: n_shared[name])
    if kind == "plan":
        return _plan(name_or_path)
    if kind == "scenario":
        check_scenario(name_or_path)
    else:
        load_config(name_or_path)
    return f"a {kind}"


def _plan(name_or_path: str) -> str:
    n_cells = len(cells(load_plan(name_or_path)))
    return f"a plan of {n_cells} cells"
