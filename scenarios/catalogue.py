"""Which scenario families and props there are: those that come with the package, and those on `TUNNELCD_PATH`.

A folder `families/` on the path adds scenarios, a folder `props/` kinds of prop; a file's name is its path below that
folder, without `.yaml`.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from cdpipe.core.errors import ScenarioError
from cdpipe.core.names import folded, require_table_name
from cdpipe.core.plugins import SEARCH_PATH, require_file_name, search_folders
from cdpipe.core.yamlfile import read_yaml, validate
from scenarios.schema import PROP_KINDS, PropFile

FAMILIES = Path(__file__).parent / "families"
# Groups of families of which each is another one, seed by seed, but for one effect of a mine.
EFFECT_GROUPS = frozenset({"cross", "dust", "dynamic", "glare", "water"})

_PROPS = {
    "box": "a box of cardboard, or of steel where it is larger than 0.75 m",
    "crate": "a slatted wooden crate on skids, with gaps between its boards",
    "chair": "a visitor's chair: tubular legs, a seat and a back rest",
    "trolley": "an upright sack truck with two wheels",
    "barrel": "a steel drum with rolling rings",
    "cone": "a traffic cone with reflective bands",
    "railing": "posts at most 1.5 m apart with three rails and a toe board",
    "pallet": "a EUR pallet, or a stack of as many as the height holds",
    "rock": "an angular fragment of rock",
    "vehicle": "a parked pick-up truck",
    "muck_pile": "blasted rock at the angle of repose, which a loader may take a share of",
}


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with the package or lie on the search path, e.g. `paper/site1`."""
    return sorted(family_files())


def prop_names() -> list[str]:
    """Return the kinds of prop that a scenario may name beside `mesh`: ours, then those on the search path."""
    return [*(kind for kind in PROP_KINDS if kind != "mesh"), *sorted(prop_files())]


def describe_prop(name: str) -> str:
    """Return what a kind of prop is, in one line.

    Raises:
        ScenarioError: The file of a kind on the search path cannot be read.
    """
    if name in _PROPS:
        return _PROPS[name]
    path = prop_files()[name]
    found = read_yaml(path).value
    mesh = found.get("mesh") if isinstance(found, dict) else None
    return f"the mesh {mesh.get('path') if isinstance(mesh, dict) else mesh} of {path}"


def family_files() -> dict[str, Path]:
    """Return the file of every scenario by its name.

    Raises:
        ScenarioError: A file on the search path has the name of another scenario.
    """
    return _found("scenario", {}, (FAMILIES, *search_folders("families")))


@cache
def clean_family(name: str) -> str | None:
    """Return the shipped family that a family is, seed by seed, but for one effect of a mine; None for any other.

    `dust/narrow` is `narrow` in dusty air, `water/null` is `unchanged/narrow` with puddles.
    """
    if name.partition("/")[0] not in EFFECT_GROUPS or name not in family_files():
        return None
    base = read_yaml(family_files()[name]).get("extends")
    return base if base in family_files() else None


@cache
def tunnel_family(name: str) -> str:
    """Return the family whose tunnels a family has, seed by seed: that which it extends without a tunnel of its own.

    `odometry/legged` and `null/narrow` have the tunnels of `narrow`, `surface/heave` those of `surface/convergence`.
    """
    if name not in family_files():
        return name
    document = read_yaml(family_files()[name]).value
    base = clean_family(name) or (document.get("extends") if "tunnel" not in document else None)
    return tunnel_family(base) if base in family_files() else name


def prop_files() -> dict[str, Path]:
    """Return the file of every kind of prop on the search path by its name.

    Raises:
        ScenarioError: A file has the name of another kind of prop.
    """
    return _found("prop", dict.fromkeys(PROP_KINDS, Path("the package")), search_folders("props"))


def family_of(path: Path) -> str:
    """Return the family that a scenario's file stands for: its name in the catalogue, else the file's own."""
    for root in (FAMILIES, *search_folders("families")):
        if path.resolve().is_relative_to(root.resolve()):
            return path.resolve().relative_to(root.resolve()).with_suffix("").as_posix()
    return path.stem


def read_prop(kind: str) -> PropFile:
    """Return a prop of the search path, the path of its mesh made absolute.

    Raises:
        InputError: Its file has mistakes: one line each.
    """
    path = prop_files()[kind]
    prop = validate(PropFile, read_yaml(path))
    mesh = prop.mesh.model_copy(update={"path": os.path.realpath(path.parent / prop.mesh.path)})
    return prop.model_copy(update={"mesh": mesh})


def _found(what: str, taken: dict[str, Path], folders: tuple[Path, ...]) -> dict[str, Path]:
    known, found = {_place(name): path for name, path in taken.items()}, {}
    for folder in folders:
        for path in sorted(folder.rglob("*.yaml")):
            name = path.relative_to(folder).as_posix().removesuffix(".yaml")
            require_file_name(path, name, require_table_name)
            if (other := known.setdefault(_place(name), path)) is not path:
                raise ScenarioError(
                    f"{SEARCH_PATH}: {path}: there is a {what} {name!r} already, in {other}: rename the file"
                )
            found[name] = path
    return found


def _place(name: str) -> str:
    """Return what two names share where their worlds would share a folder."""
    return folded(name.replace("/", "__"))
