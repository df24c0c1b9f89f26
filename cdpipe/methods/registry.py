"""The methods by name: entry points of the group `tunnelcd.methods`, for ours as for those of other packages.

A registered method is one of

- a function `(merged, before, after, config) -> ChangeReport`;
- a class or object with `detect`, called like that function;
- a class or object with `propose`, called in the same way, that returns `ChangeRegions`: the pipeline extracts the
  objects.

A class is created once per process, without arguments. `uses_descriptors = True` on any of them adds the time of the
descriptors to the method's time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import METHODS, load_entry_point, require_extra
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps

Detect = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeReport]
Propose = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeRegions]

# Methods of ours that need an extra of the same name (`cdpipe.core.plugins`).
_WITH_EXTRAS = ("m3c2", "dufomap")


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """A registered method: one of `detect` and `propose` is None.

    Attributes:
        detect: Finds regions and objects.
        propose: Finds regions only.
        uses_descriptors: Whether it reads the descriptors of the keyframes.
    """

    detect: Detect | None
    propose: Propose | None
    uses_descriptors: bool


def load_method(name: str) -> Method:
    """Return a registered method.

    Raises:
        InputError: No method has this name, it cannot be imported, its extra is not installed, or it is of none of the
            three kinds.
    """
    if name in _WITH_EXTRAS:
        require_extra(name, f"method {name}")
    found: Any = load_entry_point(METHODS, name)
    made = found() if isinstance(found, type) else found
    propose = getattr(made, "propose", None)
    detect = None if propose is not None else getattr(made, "detect", made)
    if not callable(propose or detect):
        raise InputError(f"{METHODS}: {name!r}: expected a function, or a class with `detect` or `propose`")
    return Method(detect, propose, bool(getattr(made, "uses_descriptors", False)))
