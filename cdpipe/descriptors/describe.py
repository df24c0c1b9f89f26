"""Scan descriptors of a session's keyframes; a robot computes and stores them while it maps."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.files import ArraySpec, read_npz
from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array
from cdpipe.core.geometry.path_frames import FRAMES
from cdpipe.descriptors.devices import compute, find_device
from cdpipe.descriptors.handmade import HANDMADE, VERSION
from cdpipe.descriptors.network import (
    PlaceNetwork,
    load_network,
    load_trained_network,
    make_untrained_network,
)
from cdpipe.descriptors.point_changes import range_net_digest
from cdpipe.descriptors.range_image import range_image
from cdpipe.descriptors.sphere import sphere_digest
from cdpipe.descriptors.weights_file import checkpoint_bytes, digest, read_weights
from cdpipe.model.config import DescriptorConfig, MapConfig, PipelineConfig, SphereConfig
from cdpipe.model.config.comparison import SOURCES_AT_KEYFRAMES, WHOLE_MAP_SOURCES
from cdpipe.model.types import DescriptorSet, PosedScan, ScanSource

# Scans described at a time; the features of more do not fit the cache. The results are those of batches of twice as
# many, to the byte, if what is left over from these is one batch.
_BATCH = 16
_SHIPPED = SphereConfig()
_FILE = {
    "checkpoint": ArraySpec("", "str"),
    "q": ArraySpec("K,D", "float32"),
    "w": ArraySpec("K,E", "float32", is_optional=True),
    "keyframe_scans": ArraySpec("K", "int64"),
    "odom_T_sensor": ArraySpec("S,4,4", "float64"),
    "spheres": ArraySpec("K,F", "float32 int8", is_optional=True),
    "spheres_of": ArraySpec("", "str", is_optional=True),
    "airborne": ArraySpec("", "str", is_optional=True),  # `map.airborne` of the scans; "keep" where it is left out
}


def describe_scan(scan: PosedScan, config: DescriptorConfig) -> tuple[Float32Array, Float32Array]:
    """Return q (D,) and w (64,) of one scan; D is 64, or the number of rings of a hand-made descriptor."""
    q, w = _describe([scan.points_sensor], config)
    return q[0], w[0]


def describe_scans(source: ScanSource, keyframe_scans: Int64Array, config: DescriptorConfig) -> DescriptorSet:
    """Describe the given scans of a session.

    Args:
        source: The session.
        keyframe_scans: (K,) indices of the keyframe scans, rising.
        config: `method` names the descriptor, `weights` the file of its weights.

    Raises:
        InputError: The file of weights cannot be used.
    """
    n_in_batches = len(keyframe_scans) // (2 * _BATCH) * 2 * _BATCH
    parts = [
        _describe((source.scan(index).points_sensor for index in batch.tolist()), config)
        for batch in np.split(keyframe_scans, [*range(_BATCH, n_in_batches + 1, _BATCH)])
        if len(batch)
    ]
    q = np.concatenate([part[0] for part in parts])
    w = np.concatenate([part[1] for part in parts])
    return DescriptorSet(q, w, keyframe_scans, config.method, checkpoint_digest(config))


def insert_rows(
    part: DescriptorSet, rows: Int64Array, keyframe_scans: Int64Array, known: DescriptorSet | None = None
) -> DescriptorSet:
    """Return descriptors of all K keyframes from those of some; the others keep the known ones, or have zeros.

    Args:
        part: Descriptors of R of the keyframes, without spheres.
        rows: (R,) which ones they are.
        keyframe_scans: (K,) scans of all keyframes.
        known: Descriptors of all keyframes.
    """
    q, w = (_insert(len(keyframe_scans), rows, getattr(part, n), getattr(known, n, None)) for n in ("q", "w"))
    return replace(part, q=q, w=w, keyframe_scans=keyframe_scans, spheres=None if known is None else known.spheres)


def _insert(n: int, rows: Int64Array, part: Float32Array, known: Float32Array | None) -> Float32Array:
    """Return the (n, D) known vectors, or zeros, with the (R, D) `part` in the given rows."""
    vectors = np.zeros((n, part.shape[1]), np.float32) if known is None else known.copy()
    vectors[rows] = part
    return vectors


def save_descriptors(
    folder: Path,
    descriptors: DescriptorSet,
    odom_T_sensor: Float64Array,
    map_config: MapConfig,
    sphere: SphereConfig = _SHIPPED,
) -> Path:
    """Write descriptors to `folder/descriptors/<name>.npz` and return the file; warn if it held others.

    The file also holds what they are valid for: the (S, 4, 4) poses of the session and, with sphere descriptors, the
    digest of the weights and the map settings.

    Raises:
        InputError: The file cannot be written, or would lie elsewhere because `descriptors` is a link.
    """
    path = folder / "descriptors" / f"{descriptors.name}.npz"
    partial = path.with_name(f".{path.stem}.partial.npz")
    optional: dict[str, npt.NDArray[Any]] = {} if descriptors.w is None else {"w": descriptors.w}
    if descriptors.spheres is not None:
        optional |= {"spheres": descriptors.spheres, "spheres_of": np.array(_spheres_of(map_config, sphere))}
    if map_config.airborne != "keep":
        optional["airborne"] = np.array(map_config.airborne)
    arrays = {
        "checkpoint": np.array(descriptors.checkpoint),
        "q": descriptors.q,
        "keyframe_scans": descriptors.keyframe_scans,
        "odom_T_sensor": odom_T_sensor,
        **optional,
    }
    _warn_of_others(path, arrays)
    try:
        if path.parent.is_symlink():
            raise InputError(f"{path.parent}: is a link, and nothing outside of {folder} may be written: remove it")
        path.parent.mkdir(exist_ok=True, parents=True)
        partial.unlink(missing_ok=True)  # it may be a link, which a writer would follow
        np.savez(partial, allow_pickle=False, **arrays)
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):  # a closed folder does not even let look
            partial.unlink()
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error
    return path


def _warn_of_others(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Warn if a file holds descriptors of the same poses that other settings can use and these cannot replace."""
    try:
        stored = read_npz(path, _FILE, remedy="") if path.is_file() else {}
    except InputError:
        return
    if not stored or not np.array_equal(stored["odom_T_sensor"], arrays["odom_T_sensor"]):
        return
    of_scans = [np.array_equal(stored[name], arrays[name]) for name in ("checkpoint", "keyframe_scans")]
    of_air = [str(each.get("airborne", "keep")) for each in (stored, arrays)]
    is_same_spheres = "spheres_of" not in stored or str(stored["spheres_of"]) == str(arrays.get("spheres_of"))
    if not (all(of_scans) and of_air[0] == of_air[1] and is_same_spheres):
        text = f"{path}: replaces the descriptors of other settings: with those, the session is described anew"
        warnings.warn(text, InputWarning, stacklevel=3)


def load_descriptors(
    folder: Path,
    config: DescriptorConfig,
    odom_T_sensor: Float64Array,
    map_config: MapConfig,
    sphere: SphereConfig = _SHIPPED,
) -> DescriptorSet | None:
    """Read stored descriptors; None if there are none for these weights, these poses and this rule for dust.

    Sphere descriptors are included if they are for these weights, this precision and these map settings.

    Raises:
        InputError: The file, or one of weights, is damaged.
    """
    path = folder / "descriptors" / f"{config.method}.npz"
    if not path.is_file():
        return None
    arrays = read_npz(path, _FILE, remedy="remove it and describe the session again")
    checkpoint = str(arrays["checkpoint"])
    is_of_session = np.array_equal(arrays["odom_T_sensor"], odom_T_sensor)
    is_of_air = str(arrays.get("airborne", "keep")) == map_config.airborne
    if not (is_of_session and is_of_air) or checkpoint != checkpoint_digest(config):
        return None
    spheres = arrays.get("spheres")
    if spheres is not None:
        is_same = str(arrays.get("spheres_of")) == _spheres_of(map_config, sphere)
        spheres = spheres if is_same and spheres.dtype == config.precision else None
    return DescriptorSet(arrays["q"], arrays.get("w"), arrays["keyframe_scans"], config.method, checkpoint, spheres)


def _spheres_of(map_config: MapConfig, sphere: SphereConfig) -> str:
    frames = f"{FRAMES} " if sphere.frames == "path" else ""
    return f"{sphere_digest(sphere)} {frames}{map_config.model_dump_json()}"


def checkpoint_digest(config: DescriptorConfig) -> str:
    """Return the digest of the weights of the descriptor in `config`; of a hand-made one its version.

    Raises:
        InputError: The file of weights, or the device, cannot be used.
    """
    return f"version {VERSION}" if config.method in HANDMADE else _network(config)[1]


def list_checkpoints(config: PipelineConfig) -> dict[str, str]:
    """Return the digests of the weights that a method uses: by its scan descriptor, and by a source with a network.

    Raises:
        InputError: A file of weights cannot be used.
    """
    found: dict[str, str] = {config.descriptor.method: checkpoint_digest(config.descriptor)}
    match config.regions.source:
        case "sphere":
            found["sphere"] = sphere_digest(config.sphere)
        case "range-net":
            found["range-net"] = range_net_digest(config.range_net)
    return found


def require_weights_are_read(config: PipelineConfig) -> None:
    """Refuse a file of weights that the source of regions does not read; a plugin's source may read any.

    Plans do not ask this: one `--set` is for all of their variants.

    Raises:
        InputError: `sphere.weights` or `range_net.weights` is set beside another source.
    """
    source = config.regions.source
    if source not in (*SOURCES_AT_KEYFRAMES, *WHOLE_MAP_SOURCES):
        return
    sections = (("sphere", "sphere", config.sphere.weights), ("range_net", "range-net", config.range_net.weights))
    for section, reader, weights in sections:
        if weights and source != reader:
            raise InputError(
                f"{section}.weights = {weights}: regions.source = {source} does not read them: leave them out, or "
                f"set regions.source={reader}"
            )


def use_threads(n_threads: int) -> None:
    """Set the number of threads of the network; results depend on it in the last bits."""
    torch.set_num_threads(n_threads)


def _describe(clouds_sensor: Iterable[Float64Array], config: DescriptorConfig) -> tuple[Float32Array, Float32Array]:
    """Return q (N, D) and w (N, 64) of N scans, each (M, 3) points in the sensor frame."""
    if config.method in HANDMADE:
        vectors = [HANDMADE[config.method](points) for points in clouds_sensor]
        return np.stack([q for q, _ in vectors]), np.stack([w for _, w in vectors])
    images = torch.from_numpy(np.stack([range_image(points) for points in clouds_sensor]))
    with torch.inference_mode():
        q, w = compute(_network(config)[0], images)
    return q.numpy().astype(np.float32), w.numpy().astype(np.float32)


def _network(config: DescriptorConfig) -> tuple[PlaceNetwork, str]:
    """Return the network on its device, and the digest of its weights."""
    has_own = config.method == "3deg" and config.weights
    network, of_weights = _parse(read_weights(config.weights), config.weights) if has_own else _shipped(config.method)
    return network.to(find_device(config.device)), of_weights


@cache
def _shipped(method: str) -> tuple[PlaceNetwork, str]:
    if method == "untrained":
        network = make_untrained_network()
        return network, digest(checkpoint_bytes(network))
    return load_trained_network()


@lru_cache(maxsize=4)
def _parse(content: bytes, source: str) -> tuple[PlaceNetwork, str]:
    return load_network(content, source), digest(content)
