"""Names and arrays of stage results; arrays survive the disk bit by bit.

A name holds the digest of the settings that the stage reads, of the weights, and of the names of the results that it
reads. The sessions and the code, which all stages read, are in the folder's name (stage_cache.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry.path_frames import FRAMES
from cdpipe.core.plugins import extra_version
from cdpipe.descriptors import checkpoint_digest, range_net_digest, sphere_digest
from cdpipe.methods.registry import PACKAGES
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import OF_WHOLE_MAPS, SOURCES_AT_KEYFRAMES, WHOLE_MAP_SOURCES, PipelineConfig
from cdpipe.model.report import ChangeRegions, Clusters
from cdpipe.model.types import DescriptorSet, KeyframeViews, MergedMaps, PointMap
from cdpipe.pipeline import Stage
from eval.core.provenance import digest
from eval.running.stages.stage_cache import Arrays
from eval.truth.ground_truth import SESSIONS

_PIXELS = tuple(f"{session}.return_pixels" for session in SESSIONS)


def name_result(stage: Stage, config: PipelineConfig) -> str:
    """Name the result of a stage: of both maps, of the scans' or the spheres' descriptors, of the merge, of regions.

    Regions are those that the query finds, before any is withdrawn.
    """
    read: dict[str, Any]
    match stage:
        case "maps":
            read = {"settings": config.map.model_dump(mode="json")}
        case "descriptors":  # the map only chooses the keyframes
            read = {
                "keyframe_spacing_m": config.map.keyframe_spacing_m,
                "method": config.descriptor.method,
                "weights": checkpoint_digest(config.descriptor),
                **({"airborne": "drop"} if config.map.airborne == "drop" else {}),
                **({"every": config.described_every} if config.described_every > 1 else {}),
                **({"device": config.descriptor.device} if config.descriptor.device != "cpu" else {}),
            }
        case "spheres":
            precision, weights = config.descriptor.precision, sphere_digest(config.sphere)
            frames = {"frames": FRAMES} if config.sphere.frames == "path" else {}
            read = {"maps": name_result("maps", config), "precision": precision, "weights": weights, **frames}
        case "merge":
            read = {
                "maps": name_result("maps", config),
                "descriptors": name_result("descriptors", config),
                "settings": config.merge.model_dump(mode="json"),
                "kiss_matcher": extra_version("kiss-matcher"),
            }
        case "regions":
            read = {
                "merge": name_result("merge", config),
                "spheres": name_result("spheres", config) if config.regions.source == "sphere" else None,
                "source": [config.regions.source, config.seed],
                "settings": config.query.model_dump(mode="json"),
                "own": {} if config.regions.source in SOURCES_AT_KEYFRAMES else _settings_of_clusters(config),
            }
    return f"{stage}-{digest(read)}"


def is_kept(stage: Stage, config: PipelineConfig) -> bool:
    """Return whether a result may be kept: the code of a plugin can change without a trace in its name."""
    return stage != "regions" or config.regions.source in (*SOURCES_AT_KEYFRAMES, *WHOLE_MAP_SOURCES)


def _settings_of_clusters(config: PipelineConfig) -> dict[str, Any]:
    """Return what a source that compares whole maps may read besides."""
    found = config.model_dump(mode="json", include={"outlier", *OF_WHOLE_MAPS})
    clusters = [config.cluster.radius_m, config.regions.min_points]
    if config.regions.source == "range-net":  # the digest names the weights, wherever their file lies
        found["range_net"] |= {"weights": range_net_digest(config.range_net)}
    package = PACKAGES.get(config.regions.source)
    found |= {"package": extra_version(package)} if package else {}
    return found | {"clusters": clusters}


def pack(stage: Stage, value: Any) -> Arrays:
    """Return the result of a stage as arrays by name; a merge without its maps and its seconds."""
    match stage:
        case "maps":
            arrays = _of_sessions([_packed(each) for each in value])
            # pixels rise within a scan: their differences are small, and deflate to next to nothing
            return arrays | {name: np.diff(arrays[name], prepend=np.int32(0)) for name in _PIXELS}
        case "descriptors":
            return _of_sessions([_packed(each, without=("spheres",)) for each in value])
        case "spheres":
            return dict(zip(SESSIONS, value, strict=True))
        case "merge":
            return _packed(value, without=(*SESSIONS, "seconds"))
        case "regions":
            return _packed(value)


def unpack(stage: Stage, arrays: Arrays, maps: Sequence[PointMap] = ()) -> Any:
    """Return the result of a stage from its arrays; a merge is one of `maps`, before and after."""
    match stage:
        case "maps":
            pixels = {name: np.cumsum(arrays[name], dtype=np.int32) for name in _PIXELS}
            return tuple(_map_from(_part({**arrays, **pixels}, name)) for name in SESSIONS)
        case "descriptors":
            return tuple(DescriptorSet(**{"w": None, **_plain(_part(arrays, name))}) for name in SESSIONS)
        case "spheres":
            return tuple(arrays[name] for name in SESSIONS)
        case "merge":
            local, evidence = _part(arrays, "local"), _plain(_part(arrays, "evidence"))
            alignment = PathAlignment(**_plain(local)) if local else None
            before, after = maps
            return MergedMaps(before, after, **_plain(arrays), evidence=evidence, local=alignment)
        case "regions":
            clusters = _part(arrays, "clusters")
            return ChangeRegions(**_plain(arrays), clusters=Clusters(**_plain(clusters)) if clusters else None)


def _map_from(arrays: Arrays) -> PointMap:
    views = _part(arrays, "views")
    return PointMap(**_plain(arrays), views=KeyframeViews(**_plain(views)) if views else None)


def _of_sessions(of_each: Sequence[Arrays]) -> dict[str, npt.NDArray[Any]]:
    return {f"{s}.{name}": array for s, of_one in zip(SESSIONS, of_each, strict=True) for name, array in of_one.items()}


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
