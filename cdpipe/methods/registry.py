"""The sources of regions by name: entry points of the group `tunnelcd.methods`, ours and those of other packages.

A registered source is one of

- a class or object with `propose(merged, before, after, config)`, which returns `ChangeRegions`: `extract.method` cuts
  out the objects;
- a function with these arguments that returns a whole `ChangeReport`, objects included;
- a class or object with `detect`, called like that function.

A class is created once per process, without arguments. `uses_descriptors = True` on any of them adds the time of the
descriptors to the method's time. `has_clusters = True` says that the regions hold `Clusters`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import ABSENT, METHODS, describe_entry_point, extra_version, load_entry_point, require_extra
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps

Detect = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeReport]
Propose = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeRegions]

# Sources of ours that need an extra (`cdpipe.core.plugins`), of the same name but for `_EXTRAS`, and its package.
PACKAGES = {"m3c2": "py4dgeo", "m3c2-ep": "py4dgeo", "dufomap": "dufomap", "octomap": "pyoctomap"}
_EXTRAS = {"m3c2-ep": "m3c2"}
# what each source of ours does; those of other packages are described by their docstrings
_DESCRIPTIONS = {
    "scan": "the paper: descriptors of single scans, against the most similar one or that of the same place",
    "sphere": "learned descriptors of the map around each keyframe, compared with the other map at the same place",
    "sphere-difference": "share of new points around each keyframe: no descriptor, no network",
    "every-keyframe": "every keyframe is a region: the extraction alone decides",
    "voxel-diff": "voxels of the whole map that are empty in the other map, clustered",
    "c2c": "points of the whole map far from every point of the other one (cloud to cloud), clustered",
    "m3c2": "distance of both surfaces along their normal (Lague et al. 2013), clustered; extra m3c2",
    "m3c2-ep": "m3c2 with a level of detection by error propagation (Winiwarter et al. 2021); extra m3c2",
    "dufomap": "what stands where rays of the other session saw a void (Duberg et al. 2024); extra dufomap",
    "octomap": "what stands in free voxels of the other session's occupancy map (Hornung et al. 2013); extra octomap",
    "removert": "what range images of the other session see through (Kim and Kim 2020)",
    "erasor": "what stands in columns that the other session's scans found flat (Lim et al. 2021)",
    "range-net": "a network that compares range images of both maps, pixel by pixel",
    "random-regions": "regions drawn at random: a control",
}


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """A registered method: one of `detect` and `propose` is None.

    Attributes:
        detect: Finds regions and objects.
        propose: Finds regions only.
        uses_descriptors: Whether it reads the descriptors of the keyframes.
        has_clusters: Whether it cuts out clusters of its own, for `extract.method: clusters`.
    """

    detect: Detect | None
    propose: Propose | None
    uses_descriptors: bool
    has_clusters: bool


def describe_method(name: str) -> str:
    """Return what a registered source of regions does, in one line; "" where its package does not say."""
    return _DESCRIPTIONS.get(name) or describe_entry_point(METHODS, name)


def load_source(config: PipelineConfig) -> Method:
    """Return the source of regions that the settings name.

    Raises:
        InputError: It cannot be loaded (`load_method`), or the extraction needs clusters that it does not have.
    """
    method = load_method(config.regions.source)
    if config.extract.method == "clusters" and method.detect is None and not method.has_clusters:
        raise InputError(
            f"extract.method = clusters: regions.source = {config.regions.source} cuts out nothing itself: expected "
            "surface, voxel or nearest"
        )
    return method


def list_extras(
    config: PipelineConfig, evidence: Mapping[str, float], *, proposes: bool = True, measures: bool = True
) -> dict[str, str]:
    """Return the version of every optional package that an answer depends on, by the package's name.

    Args:
        config: All settings.
        evidence: That of the merge, which says whether KISS-Matcher was asked; "absent" where it was wanted in vain.
        proposes: Whether the source of the settings proposed the regions.
        measures: Whether the displacement of the rock was measured, if the settings say so.
    """
    found = {}
    if "kiss_matcher" in evidence:
        found["kiss-matcher"] = extra_version("kiss-matcher") if evidence["kiss_matcher"] else ABSENT
    # rivals of the displacement have the names of the sources that use the same package
    names = [config.regions.source] * proposes + [config.surface.method] * measures
    packages = dict.fromkeys(PACKAGES[name] for name in names if name in PACKAGES)
    return {**found, **{package: extra_version(package) for package in packages}}


@cache
def _make(name: str) -> Any:
    found = load_entry_point(METHODS, name)
    return found() if isinstance(found, type) else found


def load_method(name: str) -> Method:
    """Return what is registered under a name; a class is created at the first call.

    Raises:
        InputError: No method has this name, it cannot be imported, its extra is not installed, or it is of none of the
            three kinds.
    """
    if name in PACKAGES:
        require_extra(_EXTRAS.get(name, name), f"regions.source = {name}")
    made = _make(name)
    propose = getattr(made, "propose", None)
    detect = None if propose is not None else getattr(made, "detect", made)
    if not callable(propose or detect):
        raise InputError(f"{METHODS}: {name!r}: expected a function, or a class with `detect` or `propose`")
    return Method(
        detect,
        propose,
        *(bool(getattr(made, mark, False)) for mark in ("uses_descriptors", "has_clusters")),
    )
