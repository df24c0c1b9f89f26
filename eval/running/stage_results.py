"""Names and arrays of stage results; arrays survive the disk bit by bit.

A name holds the digest of the settings that the stage reads, of the weights, and of the names of the results that it
reads. The sessions and the code, which all stages read, are in the folder's name (eval/running/stage_cache.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cdpipe.descriptors import checkpoint_digest, sphere_digest
from cdpipe.merge.global_registration import is_kiss_matcher_installed
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import MapConfig, PipelineConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, KeyframeViews, MergedMaps, PointMap, Spheres
from eval.core.provenance import digest
from eval.running.stage_cache import MAPS, Arrays

_SESSIONS, _PIXELS = ("before", "after"), "return_pixels"


def maps_name(config: MapConfig) -> str:
    """Name both maps."""
    return _name(MAPS, settings=config.model_dump(mode="json"))


def descriptors_name(config: PipelineConfig) -> str:
    """Name the descriptors of the keyframes' scans; the map only chooses the keyframes."""
    return _name(
        "descriptors",
        keyframe_spacing_m=config.map.keyframe_spacing_m,
        method=config.descriptor.method,
        weights=checkpoint_digest(config.descriptor),
    )


def spheres_name(config: PipelineConfig) -> str:
    """Name the descriptors of the keyframes' spheres."""
    return _name("spheres", maps=maps_name(config.map), precision=config.descriptor.precision, weights=sphere_digest())


def merge_name(config: PipelineConfig) -> str:
    """Name the merge."""
    return _name(
        "merge",
        maps=maps_name(config.map),
        descriptors=descriptors_name(config),
        settings=config.merge.model_dump(mode="json"),
        has_kiss_matcher=is_kiss_matcher_installed(),
    )


def regions_name(config: PipelineConfig) -> str:
    """Name the regions that the query finds, before any is withdrawn."""
    return _name(
        "regions",
        merge=merge_name(config),
        spheres=spheres_name(config) if config.query.compare == "sphere" else None,
        method=[config.method, config.seed, config.options],
        settings=config.query.model_dump(mode="json"),
    )


def maps_arrays(maps: Sequence[PointMap]) -> Arrays:
    """Return both maps as arrays."""
    arrays = _of_sessions([_packed(each) for each in maps])
    for name in _of_both(_PIXELS):
        # pixels rise within a scan: their differences are small, and deflate to next to nothing
        arrays[name] = np.diff(arrays[name], prepend=np.int32(0))
    return arrays


def maps_from(arrays: Arrays) -> tuple[PointMap, PointMap]:
    """Return both maps."""
    pixels = {name: np.cumsum(arrays[name], dtype=np.int32) for name in _of_both(_PIXELS)}
    before, after = (_part({**arrays, **pixels}, name) for name in _SESSIONS)
    return _map_from(before), _map_from(after)


def descriptors_arrays(descriptors: Sequence[DescriptorSet]) -> Arrays:
    """Return the descriptors of both sessions' scans as arrays; those of spheres are left out."""
    return _of_sessions([_packed(each, without=("spheres",)) for each in descriptors])


def descriptors_from(arrays: Arrays) -> tuple[DescriptorSet, DescriptorSet]:
    """Return the descriptors of both sessions' scans."""
    before, after = (DescriptorSet(**{"w": None, **_plain(_part(arrays, name))}) for name in _SESSIONS)
    return before, after


def spheres_arrays(spheres: Sequence[Spheres]) -> Arrays:
    """Return the sphere descriptors of both sessions by name."""
    return dict(zip(_SESSIONS, spheres, strict=True))


def spheres_from(arrays: Arrays) -> tuple[Spheres, Spheres]:
    """Return the sphere descriptors of both sessions."""
    before, after = (arrays[name] for name in _SESSIONS)
    return before, after


def merged_arrays(merged: MergedMaps) -> Arrays:
    """Return a merge as arrays, without its maps and its seconds."""
    return _packed(merged, without=(*_SESSIONS, "seconds"))


def merged_from(arrays: Arrays, maps: Sequence[PointMap]) -> MergedMaps:
    """Return the merge of two maps."""
    local = _part(arrays, "local")
    before, after = maps
    return MergedMaps(
        before,
        after,
        **_plain(arrays),
        evidence=_plain(_part(arrays, "evidence")),
        local=PathAlignment(**_plain(local)) if local else None,
    )


def regions_arrays(regions: ChangeRegions) -> Arrays:
    """Return regions as arrays."""
    return _packed(regions)


def regions_from(arrays: Arrays) -> ChangeRegions:
    """Return the regions."""
    return ChangeRegions(**_plain(arrays))


class StageResult(NamedTuple):
    """How a stage's result is named by what it reads, packed into arrays, and made of them and of both maps again."""

    name: Callable[[PipelineConfig], str]
    pack: Callable[[Any], Arrays]
    unpack: Callable[[Arrays, Any], Any]


STAGES = {
    "descriptors": StageResult(descriptors_name, descriptors_arrays, lambda arrays, _: descriptors_from(arrays)),
    "spheres": StageResult(spheres_name, spheres_arrays, lambda arrays, _: spheres_from(arrays)),
    "merge": StageResult(merge_name, merged_arrays, merged_from),
    "regions": StageResult(regions_name, regions_arrays, lambda arrays, _: regions_from(arrays)),
}


def _name(stage: str, **read: Any) -> str:
    return f"{stage}-{digest(read)}"


def _map_from(arrays: Arrays) -> PointMap:
    views = _part(arrays, "views")
    return PointMap(**_plain(arrays), views=KeyframeViews(**_plain(views)) if views else None)


def _of_both(name: str) -> list[str]:
    return [f"{session}.{name}" for session in _SESSIONS]


def _of_sessions(of_each: Sequence[Arrays]) -> dict[str, npt.NDArray[Any]]:
    return {
        f"{s}.{name}": array for s, of_one in zip(_SESSIONS, of_each, strict=True) for name, array in of_one.items()
    }


def _packed(value: Any, *, without: tuple[str, ...] = ()) -> dict[str, npt.NDArray[Any]]:
    """Return the fields of a dataclass as arrays; `field.name` within one that is a dataclass or a mapping of numbers.

    None is left out, and so is what `without` names.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    parts = {each.name: getattr(value, each.name) for each in fields(value) if each.name not in without}
    for name, part in parts.items():
        if is_dataclass(part):
            arrays |= {f"{name}.{inner}": array for inner, array in _packed(part).items()}
        elif isinstance(part, Mapping):
            arrays |= {f"{name}.{inner}": np.asarray(number) for inner, number in part.items()}
        elif part is not None:
            arrays[name] = np.asarray(part)
    return arrays


def _plain(arrays: Arrays) -> dict[str, Any]:
    """Return the fields that are neither dataclasses nor mappings; numbers and texts as such."""
    return {name: array if array.ndim else array.item() for name, array in arrays.items() if "." not in name}


def _part(arrays: Arrays, name: str) -> dict[str, npt.NDArray[Any]]:
    """Return what is within a field, or within a session; empty where that was None."""
    return {full.removeprefix(f"{name}."): array for full, array in arrays.items() if full.startswith(f"{name}.")}
