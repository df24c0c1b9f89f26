"""`tunnelcd doctor`: which packages are installed, whether they work, and how to repair those that do not.

A package is checked in three steps: it is installed, its version is in the range that tunnelcd requires, and it passes
a small job (`eval.cli.doctor_checks`). It is imported in its own check only, so that a broken package affects one row.
"""

from __future__ import annotations

import importlib
import platform
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import InvalidVersion, Version

from eval.cli import doctor_checks
from eval.core.provenance import TOOL, machine

State = Literal["ok", "absent", "broken"]
_PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
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
    """Yield every finding, Python and the machine first, then required packages and weights, then the extras."""
    try:
        needs = _read_requirements(_PYPROJECT)
    except metadata.PackageNotFoundError:
        yield Finding(TOOL, "broken", "not installed", True, "pip install -e . in the folder of pyproject.toml")
        return
    yield _python(needs.python)
    yield from _about_machine()
    for requirement in needs.packages:
        yield _package(requirement)
    yield _tried("weights", doctor_checks.weights, "install tunnelcd anew: its weights are part of it")
    for name, requirements in needs.extras.items():
        yield _extra(name, requirements)


def faults(findings: Sequence[Finding]) -> list[str]:
    """Return one line for every required item that does not work, with its repair."""
    return [f"{each.what}: {each.told}: {each.mend}" for each in findings if each.is_required and each.state != "ok"]


@dataclass(frozen=True, slots=True)
class _Needs:
    """What tunnelcd requires: a range of Python versions, packages, and the packages of each extra, for this Python."""

    python: str
    packages: list[Requirement]
    extras: dict[str, list[Requirement]]


def _read_requirements(pyproject: Path) -> _Needs:
    """Read the requirements from pyproject.toml in a source tree, from the metadata of the installed package elsewhere.

    Raises:
        PackageNotFoundError: There is neither.
    """
    if pyproject.is_file():
        project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
        python, lines = project["requires-python"], project["dependencies"]
        of_extra = {name: _applying(own, name) for name, own in project["optional-dependencies"].items()}
    else:
        about, lines = metadata.metadata(TOOL), metadata.requires(TOOL) or []
        python, without = about["Requires-Python"], _applying(lines)
        of_extra = {
            name: [each for each in _applying(lines, name) if each not in without]
            for name in about.get_all("Provides-Extra") or ()
        }
    extras = {name: list(_expand(own, of_extra)) for name, own in of_extra.items()}
    return _Needs(python, _applying(lines), extras)


def _applying(lines: Sequence[str], extra: str = "") -> list[Requirement]:
    every = map(Requirement, lines)
    return [each for each in every if each.marker is None or each.marker.evaluate({"extra": extra})]


def _expand(requirements: Sequence[Requirement], extras: Mapping[str, Sequence[Requirement]]) -> Iterator[Requirement]:
    """Yield requirements, those of the named extras in place of tunnelcd itself."""
    for each in requirements:
        if each.name == TOOL:
            for name in sorted(each.extras):
                yield from _expand(extras[name], extras)
        else:
            yield each


def _python(needed: str) -> Finding:
    version = platform.python_version()
    is_fine = SpecifierSet(needed).contains(version, prereleases=True)
    told = f"{version}, {sys.executable}"
    return Finding("Python", "ok" if is_fine else "broken", told, True, f"tunnelcd needs Python {needed}: install one")


def _about_machine() -> Iterator[Finding]:
    about = machine()
    cores, memory, threads = about["cores"], about["memory_gb"], about["threads"]
    yield Finding("machine", "ok", f"{about['platform']}, {about['cpu']}, {cores} cores, {memory or 'unknown'} GB")
    counts = ", ".join(f"{name} {count}" for name, count in threads.items())
    alike = set(threads.values())
    yield Finding("threads", "ok", counts if len(alike) > 1 else f"{alike.pop()} for every numeric library")
    places = dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir())))
    told = "; ".join(f"{shutil.disk_usage(place).free / 1e9:.0f} GB free in {place}" for place in places)
    yield Finding("disk", "ok", f"{told} (a pair of sessions takes 0.1 to 2 GB)")


def _package(requirement: Requirement) -> Finding:
    name, wanted = requirement.name, _without_marker(requirement)
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return Finding(name, "absent", "not installed", True, f"pip install '{wanted}'")
    if not _is_in_range(version, requirement):
        told = f"{version} is not {requirement.specifier}"
        return Finding(name, "broken", told, True, f"pip install --upgrade '{wanted}'")
    check = doctor_checks.OF_PACKAGE.get(name, partial(_import, name))
    return _tried(name, check, f"pip install --force-reinstall '{wanted}'", version)


def _extra(extra: str, requirements: Sequence[Requirement]) -> Finding:
    what, way = f"extra {extra}", f"pip install '{TOOL}[{extra}]'"
    if not requirements:
        return Finding(what, "absent", f"nothing of it is made for Python {platform.python_version()}")
    versions = {}
    for each in requirements:
        try:
            versions[each.name] = metadata.version(each.name)
        except metadata.PackageNotFoundError:
            return Finding(what, "absent", f"no {each.name}: {way}")
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    for each in requirements:
        if not _is_in_range(versions[each.name], each):
            wrong = f"{each.name} {versions[each.name]} is not {each.specifier}"
            return Finding(what, "broken", f"{wrong}: pip install --upgrade '{_without_marker(each)}'")
    check = doctor_checks.OF_EXTRA.get(extra)
    return Finding(what, "ok", told) if check is None else _tried(what, check, way, told, is_required=False)


def _is_in_range(version: str, requirement: Requirement) -> bool:
    try:
        return requirement.specifier.contains(Version(version), prereleases=True)
    except InvalidVersion:
        return False


def _without_marker(requirement: Requirement) -> str:
    return str(requirement).partition(";")[0].strip()


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
