"""Files of plans: the shipped ones, those on the search path, and any by its path."""

from __future__ import annotations

from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import find_yaml
from cdpipe.core.yamlfile import Document, read_yaml, suggest


def plan_names() -> list[str]:
    """Return the names of all plans: shipped, and on the search path."""
    return list(_find_plans())


def read_plan(name_or_path: str) -> Document:
    """Read the file of a plan: by the plan's name, or by the path of any .yaml file.

    Raises:
        InputError: It is unknown, or no YAML.
    """
    if name_or_path.endswith((".yaml", ".yml")):
        return read_yaml(Path(name_or_path))
    plans = _find_plans()
    if name_or_path not in plans:
        raise InputError(
            f"plan {name_or_path!r} is unknown{suggest(name_or_path, plans)} "
            f"(known: {', '.join(plans)}, or the path of a .yaml file)"
        )
    return read_yaml(Path(f"{name_or_path}.yaml"), plans[name_or_path].read_text(encoding="utf-8"))


def _find_plans() -> dict[str, Traversable]:
    return find_yaml("plans", resources.files("eval") / "plans")
