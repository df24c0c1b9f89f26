"""The methods by name: entry points of the group `tunnelcd.methods`; ours are registered as everybody else's are.

What is registered is one of

- a function `(merged, before, after, config) -> ChangeReport`;
- a class with `detect`, called like that function;
- a class with `propose`, called like it too, that returns `ChangeRegions`: the pipeline cuts the objects out of them.

A class is created once a process, without arguments. `uses_descriptors = True` on any of them lets the time that the
descriptors took count as the method's.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import METHODS, load_entry_point
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps

Detect = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeReport]
Propose = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeRegions]

# An extra is called as its method; the package that it installs.
_PACKAGES = {"m3c2": "py4dgeo", "dufomap": "dufomap"}


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """A registered method: either of the first two is None.

    Attributes:
        detect: What finds regions and objects.
        propose: What finds regions alone.
        uses_descriptors: Whether it reads the descriptors of the keyframes.
    """

    detect: Detect | None
    propose: Propose | None
    uses_descriptors: bool


def load_method(name: str) -> Method:
    """Return a registered method.

    Raises:
        InputError: There is none of this name, it cannot be imported, its extra is not installed, or it is none of the
            three kinds.
    """
    require_extra(name)
    found: Any = load_entry_point(METHODS, name)
    made = found() if isinstance(found, type) else found
    propose = getattr(made, "propose", None)
    detect = None if propose is not None else getattr(made, "detect", made)
    if not callable(propose or detect):
        raise InputError(f"{METHODS}: {name!r}: expected a function, or a class with `detect` or `propose`")
    return Method(detect, propose, bool(getattr(made, "uses_descriptors", False)))


def require_extra(name: str) -> None:
    """Raise `InputError` with the way out where the extra of a method is not installed."""
    package = _PACKAGES.get(name)
    if package is not None and importlib.util.find_spec(package) is None:
        raise InputError(f"method {name} needs a package more: pip install 'tunnelcd[{name}]'")
