"""What an installation adds: optional packages, entry points of plugins, and folders on `TUNNELCD_PATH`."""

from __future__ import annotations

import ast
import os
from collections.abc import Callable
from functools import cache
from importlib import metadata, resources
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.names import folded, require_name, require_table_name, visible

METHODS = "tunnelcd.methods"
METRICS = "tunnelcd.metrics"
PRESETS = "tunnelcd.presets"
SEARCH_PATH = "TUNNELCD_PATH"
ABSENT = "absent"
# Optional dependency of pyproject.toml -> the module that it installs.
_EXTRAS = {
    "m3c2": "py4dgeo", "dufomap": "dufomap", "octomap": "pyoctomap", "kiss": "kiss_matcher", "odometry": "kiss_icp",
    "genz": "genz_icp",
    "ouster": "ouster", "formats": "pypcd4", "rerun": "rerun", "gpu": "warp",
}  # fmt: skip


def has_extra(name: str) -> bool:
    """Return whether an extra of `_EXTRAS` is installed."""
    return find_spec(_EXTRAS[name]) is not None


def extra_version(package: str) -> str:
    """Return the version of an optional package, `ABSENT` where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ABSENT


def require_extra(name: str, asked_by: str) -> None:
    """Raise `InputError` unless the extra is installed; `asked_by` names the setting or method that needs it."""
    if not has_extra(name):
        raise InputError(f"{asked_by} needs a package more: pip install 'tunnelcd[{name}]'")


@cache
def entry_points(group: str) -> dict[str, metadata.EntryPoint]:
    """Return the entry points of a group by name, sorted.

    Raises:
        InputError: Two packages claim one name.
    """
    found: dict[str, metadata.EntryPoint] = {}
    for entry in sorted(metadata.entry_points(group=group), key=lambda each: each.name):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise InputError(
                f"{group}: {entry.name!r} is claimed by {other.value} and by {entry.value}: rename or uninstall one"
            )
    return found


@cache
def load_entry_point(group: str, name: str) -> Any:
    """Return the object behind an entry point.

    Raises:
        InputError: Nothing is registered under this name, or it cannot be imported.
    """
    entry = entry_points(group).get(name)
    if entry is None:
        known = ", ".join(entry_points(group))
        raise InputError(f"{group}: {name!r} is not registered (registered: {known}): install the package that has it")
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"{group}: {name!r} = {entry.value} cannot be imported: {error}") from error


def describe_entry_point(group: str, name: str) -> str:
    """Return the first line of the docstring of the class or function behind an entry point, else of its module.

    The object is not imported: its package may be slow, or need what is not installed. "" where there is no docstring.
    """
    entry = entry_points(group)[name]
    try:
        spec = find_spec(entry.module)
        tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else "")
    except (ImportError, OSError, ValueError, SyntaxError):
        return ""
    own = [
        node
        for node in tree.body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == entry.attr.partition(".")[0]
    ]
    return next((line for node in (*own, tree) if (line := (ast.get_docstring(node) or "").partition("\n")[0])), "")


def search_folders(kind: str) -> tuple[Path, ...]:
    """Return the folders `DIR/kind` of the directories on `TUNNELCD_PATH` that exist, in order.

    Args:
        kind: `presets`, `plans`, `families` or `props`.

    Raises:
        InputError: A directory on the path does not exist.
    """
    folders = [Path(entry) for entry in os.environ.get(SEARCH_PATH, "").split(os.pathsep) if entry]
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{SEARCH_PATH}: {folder}: no such folder: correct or unset the variable")
    return tuple(folder / kind for folder in folders if (folder / kind).is_dir())


def find_yaml(kind: str, *shipped: Traversable, group: str | None = None) -> dict[str, Traversable]:
    """Return the YAML files of a kind by name (without `.yaml`), sorted: shipped, of plugins, on `TUNNELCD_PATH`.

    Args:
        kind: Name of the folder on the search path, e.g. `presets`.
        shipped: Folders of this package.
        group: Entry-point group; each entry names a package that contains such files.

    Raises:
        InputError: Two files claim one name or one folder's name, a name is none (`require_name`), or a plugin's
            package cannot be found.
    """
    folders = [*shipped]
    for entry in entry_points(group).values() if group else ():
        try:
            folders.append(resources.files(entry.value))
        except ImportError as error:
            raise InputError(f"{group}: {entry.name!r} = {entry.value}: no such package: {error}") from error
    found: dict[str, Traversable] = {}
    places: dict[str, Traversable] = {}
    for file in (file for folder in (*folders, *search_folders(kind)) for file in folder.iterdir()):
        if file.name.endswith(".yaml"):
            check = require_table_name if kind == "presets" else require_name
            name = require_file_name(file, file.name.removesuffix(".yaml"), check)
            if (other := places.setdefault(folded(name), file)) is not file:
                raise InputError(f"{file}: there is another of this name, {other}: rename it")
            found[name] = file
    return dict(sorted(found.items()))


def require_file_name(file: Traversable, name: str, check: Callable[[str], str] = require_name) -> str:
    """Return the name that a file gives to what it holds.

    Raises:
        InputError: `check` raises ValueError.
    """
    try:
        return check(name)
    except ValueError as error:
        raise InputError(f"{visible(str(file))}: {error}: rename the file") from error
