"""`tunnelcd doctor`: which packages are installed, whether they work, and how to repair those that do not.

A package is checked in three steps: it is installed, new enough, and passes a small job (`eval.cli.doctor_checks`). It
is imported in its own check only, so that a broken package affects one row.
"""

from __future__ import annotations

import importlib
import platform
import re
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Literal

from eval.cli import doctor_checks
from eval.core.provenance import TOOL, machine

State = Literal["ok", "absent", "broken"]
_OLDEST_PYTHON = (3, 11)
_MODULES = {"pillow": "PIL", "PyYAML": "yaml", "scikit-image": "skimage", "Jinja2": "jinja2"}


@dataclass(frozen=True, slots=True)
class Finding:
    """One row: a checked item, its state, the findings, and the repair.

    Attributes:
        what: A package, an extra, or something about the machine.
        state: "absent" and "broken" matter only where it is required.
        told: The findings in words.
        is_required: Whether tunnelcd needs it.
        mend: The repair, "" where the state is ok.
    """

    what: str
    state: State
    told: str
    is_required: bool = False
    mend: str = ""


def examine() -> Iterator[Finding]:
    """Yield every finding, the machine first, then required packages and weights, then the extras."""
    yield from _about_machine()
    try:
        needed, extras = _requirements()
    except metadata.PackageNotFoundError:
        yield Finding(TOOL, "broken", "not installed", True, "pip install -e . in the folder of pyproject.toml")
        return
    for requirement in needed:
        yield _package(requirement)
    yield _tried("weights", doctor_checks.weights, "install tunnelcd anew: its weights are part of it")
    for name, requirements in extras.items():
        yield _extra(name, requirements)


def faults(findings: Sequence[Finding]) -> list[str]:
    """Return one line for every required item that does not work, with its repair."""
    return [f"{each.what}: {each.told}: {each.mend}" for each in findings if each.is_required and each.state != "ok"]


def _about_machine() -> Iterator[Finding]:
    version = platform.python_version()
    is_new = sys.version_info[:2] >= _OLDEST_PYTHON
    yield Finding("Python", "ok" if is_new else "broken", f"{version}, {sys.executable}", True, "install 3.11 or newer")
    about = machine()
    cores, memory, threads = about["cores"], about["memory_gb"], about["threads"]
    yield Finding("machine", "ok", f"{about['platform']}, {about['cpu']}, {cores} cores, {memory or 'unknown'} GB")
    counts = ", ".join(f"{name} {count}" for name, count in threads.items())
    alike = set(threads.values())
    yield Finding("threads", "ok", counts if len(alike) > 1 else f"{alike.pop()} for every numeric library")
    places = dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir())))
    told = "; ".join(f"{shutil.disk_usage(place).free / 1e9:.0f} GB free in {place}" for place in places)
    yield Finding("disk", "ok", f"{told} (a pair of sessions takes 0.1 to 2 GB)")


def _requirements() -> tuple[list[str], dict[str, list[str]]]:
    """Return the requirements of tunnelcd and of each extra, from pyproject.toml if it runs from a source tree."""
    file = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if file.is_file():
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        return project["dependencies"], project["optional-dependencies"]
    needed: list[str] = []
    extras: dict[str, list[str]] = {}
    for line in metadata.requires(TOOL) or ():
        requirement, _, marker = line.partition(";")
        of_extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", marker)
        (extras.setdefault(of_extra[1], []) if of_extra else needed).append(requirement.strip())
    return needed, extras


def _package(requirement: str) -> Finding:
    name = _name(requirement)
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return Finding(name, "absent", "not installed", True, f"pip install '{requirement}'")
    lowest = requirement.partition(">=")[2]
    if _numbers(version) < _numbers(lowest):
        told = f"{version} is older than {lowest}"
        return Finding(name, "broken", told, True, f"pip install --upgrade '{requirement}'")
    check = doctor_checks.OF_PACKAGE.get(name, partial(_import, name))
    return _tried(name, check, f"pip install --force-reinstall '{requirement}'", version)


def _extra(extra: str, requirements: Sequence[str]) -> Finding:
    what, way = f"extra {extra}", f"pip install '{TOOL}[{extra}]'"
    versions = {}
    for name in map(_name, requirements):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            return Finding(what, "absent", f"no {name}: {way}")
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    check = doctor_checks.OF_EXTRA.get(extra)
    return Finding(what, "ok", told) if check is None else _tried(what, check, way, told, is_required=False)


def _tried(what: str, check: Callable[[], str], mend: str, told: str = "", *, is_required: bool = True) -> Finding:
    """Run a check; any exception is the fault."""
    try:
        found = check()
    except Exception as error:  # a package that is broken may raise anything
        line = " ".join(f"{type(error).__name__}: {error}".split())
        words = "; ".join(part for part in (told, line) if part)
        return Finding(what, "broken", words if is_required else f"{words}: {mend}", is_required, mend)
    return Finding(what, "ok", "; ".join(part for part in (told, found) if part), is_required)


def _import(name: str) -> str:
    importlib.import_module(_MODULES.get(name, name.replace("-", "_")))
    return ""


def _name(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0]


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version.partition("+")[0])[:3])
