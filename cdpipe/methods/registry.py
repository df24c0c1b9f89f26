"""The methods by name: entry points of the group `tunnelcd.methods`; ours are registered as everybody else's are."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any, Protocol

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import METHODS, load_entry_point
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps


class Detector(Protocol):
    """A method that needs more than a function: the class is created without arguments, once a process."""

    def detect(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeReport:
        """Say what changed between two merged maps."""


Method = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeReport]
"""`method(merged, before, after, config)`: what changed between two merged maps.

`before` and `after` say which scans are keyframes and hold the keyframes' descriptors.
"""

# Extras are called as their method; the package that each of them installs.
_PACKAGES = {"m3c2": "py4dgeo", "dufomap": "dufomap"}


def load_method(name: str) -> Method:
    """Return a registered method.

    Raises:
        InputError: There is none of this name, it cannot be imported, or its extra is not installed.
    """
    require_extra(name)
    found: Any = load_entry_point(METHODS, name)
    if isinstance(found, type):
        found = found()
    method: Any = getattr(found, "detect", found)
    if not callable(method):
        raise InputError(f"{METHODS}: {name!r} is neither a function nor a class with `detect`")
    checked: Method = method
    return checked


def require_extra(name: str) -> None:
    """Raise `InputError` with the way out where the extra of a method is not installed."""
    package = _PACKAGES.get(name)
    if package is not None and importlib.util.find_spec(package) is None:
        raise InputError(f"method {name} needs a package more: pip install 'tunnelcd[{name}]'")
