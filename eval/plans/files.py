"""Files of plans: the shipped ones, those on the search path, and any by its path."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files import YamlError, parse_yaml_value
from cdpipe.core.plugins import find_yaml
from cdpipe.core.yamlfile import Document, read_yaml, read_yaml_text, suggest
from cdpipe.model.config import WEIGHTS
from eval.plans.worlds import format_setting


def plan_names() -> list[str]:
    """Return the names of all plans: shipped, and on the search path."""
    return list(plan_files())


def read_plan(name_or_path: str) -> Document:
    """Read the file of a plan: by the plan's name, or by the path of any .yaml file.

    Returns:
        The document; files of weights that its settings name by relative paths start at the plan's folder.

    Raises:
        InputError: It is unknown, or no YAML.
    """
    if name_or_path.endswith((".yaml", ".yml")):
        if not Path(name_or_path).exists():
            raise InputError(f"{name_or_path}: no such file: expected a plan, or a name of `tunnelcd list plans`")
        return _resolve_files(read_yaml(Path(name_or_path)), Path(name_or_path).parent)
    plans = plan_files()
    if name_or_path not in plans:
        beside = f"{name_or_path}.yaml"
        near = f'; did you mean the file "{beside}"?' if Path(beside).is_file() else suggest(name_or_path, plans)
        raise InputError(
            f"plan {name_or_path!r} is unknown{near} (known: {', '.join(plans)}, or the path of a .yaml file)"
        )
    document = read_yaml(Path(f"{name_or_path}.yaml"), read_yaml_text(plans[name_or_path]))
    return _resolve_files(document, Path(str(plans[name_or_path])).parent)


def _resolve_files(document: Document, folder: Path) -> Document:
    """Return a plan whose weights are paths as seen from the working folder, in `key=value` settings and in grids."""

    def resolve(tree: Any, key: str = "") -> Any:
        if isinstance(tree, dict):
            return {name: resolve(value, str(name)) for name, value in tree.items()}
        if isinstance(tree, list):
            return [resolve(value, key) for value in tree]
        if not isinstance(tree, str):
            return tree
        if key in WEIGHTS:
            return str(folder / tree) if tree else tree
        name, _, text = tree.partition("=")
        try:
            file = parse_yaml_value(text) if name in WEIGHTS else None
        except YamlError:
            return tree  # whoever reads the setting says so
        return format_setting(name, str(folder / file)) if file and isinstance(file, str) else tree

    return replace(document, value=resolve(document.value))


def plan_files() -> dict[str, Traversable]:
    """Return the file of every plan by its name: shipped, and on the search path."""
    return find_yaml("plans", resources.files("eval") / "plans" / "shipped")
