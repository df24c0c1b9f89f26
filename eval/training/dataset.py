"""Training data of one tunnel: a pair is simulated, mapped and merged by the truth in memory, and becomes a shard.

The images come from the pipeline's own maps and renderer, at the before keyframes (the anchors). The after map is
transformed by the true alignment. Every draw after the first adds a merge error of its own: a translation in the map
frame and a rotation about the anchor, each component normal, drawn from (seed, "dataset-merge-error").
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array, invert, stream, transform, yaw_rad
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.core.geometry.path_frames import FRAMES, path_frames
from cdpipe.descriptors import sphere_image
from cdpipe.descriptors.range_image import range_image
from cdpipe.descriptors.sphere_image import COLUMNS, CROP_M, HALF_LENGTH_M, REACH_M, ROWS, pixels, render
from cdpipe.mapping.mapping import build_map, choose_keyframes
from cdpipe.model.config import MapConfig, load_config
from cdpipe.model.types import DescriptorSet, MappedSession, PointMap, PosedScan, ScanSource, WrappedScans
from cdpipe.training.shard import CHANGE_KINDS, FORMAT_VERSION, encode_shard, split_of
from eval.core.provenance import digest
from eval.graft import make_afters
from eval.oracles.merge import OracleMerge, merged_by_truth
from eval.scoring.merge_metrics import PAIR_RADIUS_M
from eval.scoring.region_metrics import label_keyframes, transform_to_map
from eval.truth.adapters import held_input
from eval.truth.ground_truth import SESSIONS, GroundTruth, SessionTruth, ground_truth
from eval.truth.scoring_points import ScoringPointsBuilder
from scenarios.grafted import GraftScenario
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario, SessionPlan
from sim.session.simulate import LabelledSession
from sim.session.truth import PairTruth

_MAX_CHANGES = 255  # labels are bytes
# Mapped at a time: their sums stay in the cache, which takes a quarter off the mapping of 64 at a time.
_BATCH_SCANS = 16
Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings that all shards of a dataset share.

    Attributes:
        draws: After images of each anchor; the first is merged exactly.
        error_m: Standard deviation of each component of a draw's translation.
        error_deg: Standard deviation of each component of a draw's rotation.
        settings: `key=value` settings written over the scenarios.
        afters: After sessions of each tunnel, all of them compared with its one before session.
    """

    draws: int = 4
    error_m: float = 0.03
    error_deg: float = 0.2
    settings: tuple[str, ...] = ()
    afters: int = 1

    def document(self) -> dict[str, Any]:
        """Return what files say of it; `afters` only where there are several."""
        told = asdict(self)
        return told if self.afters > 1 else {name: value for name, value in told.items() if name != "afters"}


@dataclass(frozen=True, slots=True, eq=False)
class _Mapped:
    """A mapped session: its map, truth, range images of its keyframes, and the change id of each map point."""

    map: PointMap
    truth: SessionTruth
    ranges_m: npt.NDArray[np.float16]
    stamps_ns: Int64Array
    point_changes: npt.NDArray[np.uint8]


def shard_digest(scenario: Scenario, seed: int, recipe: Recipe) -> str:
    """Return the digest of all inputs of a shard except code; known before the simulation."""
    image = ROWS, COLUMNS, HALF_LENGTH_M, REACH_M, list(sphere_image.sphere_image(np.zeros((0, 3))).shape), FRAMES
    return digest(
        {
            "format_version": FORMAT_VERSION,
            "scenario": scenario.model_dump(mode="json"),
            "files": file_digests(scenario),
            "seed": seed,
            "recipe": recipe.document(),
            "map": _load_map_config().model_dump(mode="json"),
            "image": image,
        }
    )


def make_shard(family: str, seed: int, recipe: Recipe) -> bytes:
    """Simulate one tunnel and return the shard of its first after session, see `make_shards`."""
    return make_shards(family, seed, replace(recipe, afters=1))[0]


def make_shards(family: str, seed: int, recipe: Recipe) -> list[bytes]:
    """Simulate one tunnel and return its shards (`cdpipe.training.shard`), one for each after session.

    Every after session but the first has line and odometry of a draw of its own. World and before session are made and
    mapped once.

    Raises:
        ScenarioError: The world cannot be built, the sessions do not overlap, or changes exceed the labels.
        InputError: A file that the scenario names cannot be read.
    """
    scenario = load_scenario(family, seed, recipe.settings)
    plans = [_draw_after(family, scenario, seed, recipe, number) for number in range(2, recipe.afters + 1)]
    shards: list[bytes] = []
    before: _Mapped | None = None
    for pair in make_afters(scenario, plans, seed):
        if len(pair.truth.changes) > _MAX_CHANGES:
            raise ScenarioError(f"{family}: {len(pair.truth.changes)} changes, labels can tell {_MAX_CHANGES} apart")
        before = before or _map_held(pair.sessions["before"])
        after = _map_held(pair.sessions["after"])
        shards.append(_make_pair_shard(family, scenario, pair.truth, (before, after), recipe))
    return shards


def _draw_after(family: str, scenario: Scenario, seed: int, recipe: Recipe, number: int) -> SessionPlan:
    """Return the after session of a scenario with line and odometry of another draw of its family."""
    other = int(stream(seed, "dataset-after", str(number)).integers(10_000))
    drawn = load_scenario(family, other, recipe.settings).after
    return scenario.after.model_copy(update={"lateral": drawn.lateral, "odometry": drawn.odometry})


def _make_pair_shard(
    family: str, scenario: Scenario, told: PairTruth, mapped: tuple[_Mapped, _Mapped], recipe: Recipe
) -> bytes:
    (before, after), seed = mapped, told.seed
    truth = ground_truth(told, {"before": before.truth, "after": after.truth})
    merged = merged_by_truth(
        _strip_descriptors(before), _strip_descriptors(after), (before.truth, after.truth), OracleMerge(), seed
    )
    if not merged.is_accepted:
        raise ScenarioError(f"{family}: {merged.reason}")
    arrays = {
        **_list_keyframes(before, after),
        **_render_images(before, after, merged.alignment.to_map(after.map.points), truth, recipe, seed),
        **_find_places(before, after, truth),
        **_list_changes(before, truth),
        **{f"draw_{name}": array for name, array in draw_merge_errors(recipe, seed).items()},
    }
    about = {
        "family": family,
        "seed": seed,
        "split": split_of(seed),
        "digest": shard_digest(scenario, seed, recipe),
        "recipe": recipe.document(),
        "score_radius_m": told.score_radius_m,
        "changes": [{"name": change.name, "prop_kind": change.prop_kind} for change in told.changes],
        "counts": _count_arrays(arrays),
        **({"is_recorded": True} if isinstance(scenario, GraftScenario) else {}),
    }
    return encode_shard(arrays, about)


def _load_map_config() -> MapConfig:
    """Return the map settings of `tunnelcd` with the recorded poses: the truth of a scan is in their frame.

    Movers stay: where walls stand twice, they would look like movers.
    """
    return load_config("tunnelcd").map.model_copy(update={"consistency": "none", "movers": "keep"})


class _WatchedScans(WrappedScans):
    """A source that shows every scan to a watcher when all scans are read for the first time."""

    def __init__(self, source: ScanSource, watch: Callable[[PosedScan], None]) -> None:
        super().__init__(source)
        self._watch: Callable[[PosedScan], None] | None = watch

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order, each seen by the watcher first."""
        watch, self._watch = self._watch, None
        for scan in super().scans():
            if watch is not None:
                watch(scan)
            yield scan


def _map_held(held: LabelledSession) -> _Mapped:
    """Map a session, and note what its scans hold while they are read."""
    config, session = _load_map_config(), held.session
    chosen = set(choose_keyframes(session.odom_T_sensor, config.keyframe_spacing_m).tolist())
    builder = ScoringPointsBuilder(str(session.path), session.rows, session.sensor.width)
    ranges_m, stamps_ns = [], []

    def watch(scan: PosedScan) -> None:
        builder.add(scan, held.instance[scan.index], held.change[scan.index])
        if scan.index in chosen:
            ranges_m.append(range_image(scan.points_sensor))
            stamps_ns.append(int(scan.stamps_ns.min()))

    point_map = build_map(_WatchedScans(held_input(session), watch), config, _BATCH_SCANS)
    truth = SessionTruth(session.odom_T_sensor, held.world_T_sensor, builder.finish(session.n_scans))
    return _Mapped(
        point_map,
        truth,
        np.array(ranges_m, dtype=np.float16),
        np.array(stamps_ns, dtype=np.int64),
        find_changes_of_points(point_map, held.change),
    )


def find_changes_of_points(point_map: PointMap, change: npt.NDArray[np.int16]) -> npt.NDArray[np.uint8]:
    """Return the (N,) change id of each map point: that of most of its changed returns, 0 where it has none.

    Args:
        point_map: The map.
        change: (S, H, W) change of every return.
    """
    offsets = point_map.scan_offsets
    found = []
    for scan in np.flatnonzero(change.any(axis=(1, 2))):
        returns = slice(offsets[scan], offsets[scan + 1])
        ids = change[scan].ravel()[point_map.return_pixels[returns]].astype(np.int64)
        is_changed = ids > 0
        found.append(point_map.return_points[returns][is_changed] * np.int64(_MAX_CHANGES + 1) + ids[is_changed])
    changes = np.zeros(len(point_map.points), dtype=np.uint8)
    if found:
        pairs, counts = np.unique(np.concatenate(found), return_counts=True)
        order = np.argsort(counts, kind="stable")  # the last one written to a point has the most returns
        points, ids = np.divmod(pairs[order], _MAX_CHANGES + 1)
        changes[points] = ids
    return changes


def _strip_descriptors(mapped: _Mapped) -> MappedSession:
    """Return a mapped session without descriptors, which a merge by the truth does not need."""
    scans = mapped.map.keyframe_scans
    return MappedSession(mapped.map, DescriptorSet(np.zeros((len(scans), 1), np.float32), None, scans, "none", ""))


def _list_keyframes(before: _Mapped, after: _Mapped) -> Arrays:
    sessions = {"before": before, "after": after}
    per_session: dict[str, Callable[[_Mapped], npt.NDArray[Any]]] = {
        "scans": lambda mapped: mapped.map.keyframe_scans,
        "stamps_ns": lambda mapped: mapped.stamps_ns,
        "world_T_keyframe": lambda mapped: mapped.truth.world_T_sensor[mapped.map.keyframe_scans],
        "odom_T_keyframe": lambda mapped: mapped.map.odom_T_keyframe,
        "ranges_m": lambda mapped: mapped.ranges_m,
    }
    return {f"{name}_{key}": of(mapped) for key, of in per_session.items() for name, mapped in sessions.items()}


def draw_merge_errors(recipe: Recipe, seed: int) -> Arrays:
    """Return the (D, 3) translations and rotation vectors of the draws; fewer draws are the first of more."""
    drawn = stream(seed, "dataset-merge-error").normal(size=(recipe.draws, 2, 3))
    drawn[0] = 0.0
    return {"shift_m": recipe.error_m * drawn[:, 0], "turn_rad": np.deg2rad(recipe.error_deg) * drawn[:, 1]}


def displace_poses(map_T_anchor: Float64Array, shift_m: Float64Array, turn_rad: Float64Array) -> Float64Array:
    """Return the (K, 4, 4) poses from which a map looks as its displaced copy looks from the anchors.

    Args:
        map_T_anchor: (K, 4, 4) the anchors.
        shift_m: (3,) translation of the map's points after the rotation, map frame.
        turn_rad: (3,) rotation vector about the anchor.
    """
    turned = Rotation.from_rotvec(turn_rad).as_matrix()
    poses = map_T_anchor.copy()
    poses[:, :3, :3] = turned.T @ map_T_anchor[:, :3, :3]
    poses[:, :3, 3] -= turned.T @ shift_m
    return poses


def _render_images(
    before: _Mapped, after: _Mapped, after_map: Float64Array, truth: GroundTruth, recipe: Recipe, seed: int
) -> Arrays:
    anchors = path_frames(before.map.odom_T_sensor, before.map.keyframe_scans)
    draws = draw_merge_errors(recipe, seed)
    poses = [displace_poses(anchors, *error) for error in zip(draws["shift_m"], draws["turn_rad"], strict=True)]
    after_index = GridIndex(after_map)
    before_labels = label_images(before.map.points, before.point_changes, anchors)
    after_labels = np.stack([label_images(after_map, after.point_changes, each) for each in poses])
    ids = [change.id for change in truth.pair.changes]
    return {
        "before_images": render(GridIndex(before.map.points), anchors),
        "after_images": np.stack([render(after_index, each) for each in poses]),
        "before_labels": before_labels,
        "after_labels": after_labels,
        "before_visible": _count_visible(before_labels, ids),
        "after_visible": _count_visible(after_labels, ids),
    }


def label_images(
    points: Float64Array, point_changes: npt.NDArray[np.uint8], map_T_anchor: Float64Array
) -> npt.NDArray[np.uint8]:
    """Return the (K, ROWS, COLUMNS) change id of each pixel: that of the changed point nearest to the axis.

    Args:
        points: (N, 3) points of a map.
        point_changes: (N,) change id of each point.
        map_T_anchor: (K, 4, 4) poses of the images.
    """
    is_changed = point_changes > 0
    changed, ids = points[is_changed], point_changes[is_changed]
    labels = np.zeros((len(map_T_anchor), ROWS * COLUMNS), dtype=np.uint8)
    if len(changed) == 0:
        return labels.reshape(-1, ROWS, COLUMNS)
    index = GridIndex(changed)
    for image, map_T_here, anchor_T_map in zip(labels, map_T_anchor, invert(map_T_anchor), strict=True):
        near = index.crop(map_T_here[:3, 3], CROP_M)
        points_anchor = transform(anchor_T_map, changed[near])
        pixel = pixels(points_anchor)
        order = np.argsort(-np.hypot(points_anchor[:, 1], points_anchor[:, 2]), kind="stable")
        order = order[pixel[order] >= 0]
        image[pixel[order]] = ids[near[order]]
    return labels.reshape(-1, ROWS, COLUMNS)


def _count_visible(labels: npt.NDArray[np.uint8], ids: Sequence[int]) -> npt.NDArray[np.int32]:
    counts = [np.count_nonzero(labels == number, axis=(-2, -1)) for number in ids]
    return np.stack(counts, axis=-1).astype(np.int32) if counts else np.zeros((*labels.shape[:-2], 0), np.int32)


def _find_places(before: _Mapped, after: _Mapped, truth: GroundTruth) -> Arrays:
    here = before.truth.world_T_sensor[before.map.keyframe_scans]
    there = after.truth.world_T_sensor[after.map.keyframe_scans]
    distance_m, nearest = cKDTree(there[:, :3, 3]).query(here[:, :3, 3])
    turns = [yaw_rad(there[j]) - yaw_rad(here[i]) for i, j in enumerate(np.asarray(nearest))]
    labels = label_keyframes(here[:, :3, 3], truth.centroids_world, truth.is_observable, truth.pair.score_radius_m)
    return {
        "labels": labels.astype(np.int8),
        "is_covered": np.asarray(distance_m <= PAIR_RADIUS_M),
        "nearest_after": np.asarray(nearest, dtype=np.int64),
        "nearest_m": np.asarray(distance_m, dtype=np.float64),
        "nearest_yaw_rad": np.angle(np.exp(1j * np.array(turns))),
    }


def _list_changes(before: _Mapped, truth: GroundTruth) -> Arrays:
    changes, centroids = truth.pair.changes, truth.centroids_world
    return {
        "change_ids": np.array([change.id for change in changes], dtype=np.int64),
        "change_session": np.array([SESSIONS.index(change.session) for change in changes], dtype=np.uint8),
        "change_kind": np.array([CHANGE_KINDS.index(change.kind) for change in changes], dtype=np.uint8),
        "change_is_partial": truth.is_partial,
        "change_is_observable": truth.is_observable,
        "change_n_cells": np.array([len(rows) for rows in truth.change_rows], dtype=np.int64),
        "change_centroid_world": centroids,
        "change_centroid_odom": transform_to_map(centroids, before.truth),
    }


def _count_arrays(arrays: Arrays) -> dict[str, int]:
    labels = arrays["labels"]
    return {
        "n_before": len(arrays["before_scans"]),
        "n_after": len(arrays["after_scans"]),
        "n_covered": int(arrays["is_covered"].sum()),
        "n_positive": int(np.count_nonzero(labels == 1)),
        "n_negative": int(np.count_nonzero(labels == 0)),
        "n_changes": len(arrays["change_ids"]),
        "n_observable": int(arrays["change_is_observable"].sum()),
    }
