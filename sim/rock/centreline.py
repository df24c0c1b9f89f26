"""The graph of centrelines: nodes and drifts of a tunnel with rounded corners and a drawn meander."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from scenarios.schema import Drift, Niche, Section, Tunnel
from sim.geometry.noise import noise_at, smooth_noise

STEP_M = 0.1
# Nodes are places where things may stand, so a blind drift goes on for half its width behind its last node.
_BLIND_SHARE = 0.5
_VARIATION_LIMIT_SIGMA = 2.5
_SMALLEST_SHARE = 0.5  # of the nominal size that a drift narrows or lowers to


@dataclass(frozen=True, slots=True, eq=False)
class DriftLine:
    """The centreline of one drift, at floor level, in the world frame.

    Attributes:
        points: (N, 3) samples about 0.1 m apart, metres.
        headings: (N, 2) unit direction of travel in the x-y plane.
        section: Its cross-section at nominal size.
        width_m: (N,) width there, variation included.
        height_m: (N,) height there.
        node_samples: Sample that stands for each node, in the drift's order.
        is_blind: Whether the line ends in rock at its start and at its end.
    """

    points: Float64Array
    headings: Float64Array
    section: Section
    width_m: Float64Array
    height_m: Float64Array
    node_samples: tuple[int, ...]
    is_blind: tuple[bool, bool]


@dataclass(frozen=True, slots=True, eq=False)
class Recess:
    """A niche in its place.

    Attributes:
        drift: Number of the drift whose wall it is in.
        point: (3,) on the centreline, abreast of its middle.
        heading: (2,) unit direction of the drift there.
        outward: (2,) unit direction from the centreline into the niche.
        back_m: Distance from the centreline to its back wall.
        width_m: Along the drift.
        height_m: Above the drift's floor.
    """

    drift: int
    point: Float64Array
    heading: Float64Array
    outward: Float64Array
    back_m: float
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Centreline:
    """All drifts of a tunnel, where the edge between two nodes lies, and the niches."""

    drifts: tuple[DriftLine, ...]
    edges: dict[tuple[str, str], tuple[int, int, int]]
    recesses: tuple[Recess, ...] = ()

    def edge(self, start: str, end: str) -> tuple[Float64Array, Section]:
        """Return the (N, 3) centreline from one node to a neighbouring one, and its nominal section."""
        drift, first, last = self.edges[start, end]
        line = self.drifts[drift]
        step = 1 if last >= first else -1
        samples = np.arange(first, last + step, step)
        return line.points[samples], line.section

    def at(self, start: str, end: str, fraction: float) -> tuple[Float64Array, Float64Array, Section]:
        """Return the point (3,) and heading (2,) a share of the way between two neighbouring nodes, and the section."""
        drift, first, last = self.edges[start, end]
        line = self.drifts[drift]
        position = first + fraction * (last - first)
        samples = np.arange(len(line.points))
        point = np.array([np.interp(position, samples, line.points[:, axis]) for axis in range(3)])
        heading = line.headings[round(position)] * (1.0 if last >= first else -1.0)
        return point, heading, line.section


def build_centreline(tunnel: Tunnel, seed: int) -> Centreline:
    """Round the corners of every drift and add the meander and the change of size that the seed draws.

    In a foreign mesh the drifts follow their nodes: no meander, and nothing beyond a last node.

    Raises:
        ScenarioError: Two neighbouring nodes of a drift coincide, or a niche is higher than its drift.
    """
    uses = Counter(node for drift in tunnel.drifts for node in drift.nodes)
    drifts = tuple(_drift_line(tunnel, index, drift, uses, seed) for index, drift in enumerate(tunnel.drifts))
    edges: dict[tuple[str, str], tuple[int, int, int]] = {}
    for index, (drift, line) in enumerate(zip(tunnel.drifts, drifts, strict=True)):
        for (a, b), (first, last) in zip(pairwise(drift.nodes), pairwise(line.node_samples), strict=True):
            edges.setdefault((a, b), (index, first, last))
            edges.setdefault((b, a), (index, last, first))
    recesses = tuple(_recess(niche, index, drifts, edges) for index, niche in enumerate(tunnel.niches))
    return Centreline(drifts, edges, recesses)


def resample(points: Float64Array, step_m: float) -> Float64Array:
    """Return points on the same polyline at equal distances of about `step_m`, both ends kept."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    n_steps = max(1, round(lengths[-1] / step_m))
    wanted = np.linspace(0.0, lengths[-1], n_steps + 1)
    return np.stack([np.interp(wanted, lengths, points[:, axis]) for axis in range(points.shape[1])], axis=1)


def headings_of(points: Float64Array) -> Float64Array:
    """Return the (N, 2) unit directions of a densely sampled line in the x-y plane."""
    tangents = np.gradient(points[:, :2], axis=0)
    return np.asarray(tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12))


def left_of(headings: Float64Array) -> Float64Array:
    """Return the (N, 2) directions at right angles to the left."""
    return np.stack([-headings[:, 1], headings[:, 0]], axis=1)


def _drift_line(tunnel: Tunnel, index: int, drift: Drift, uses: Counter[str], seed: int) -> DriftLine:
    section = drift.section or tunnel.section
    nodes = np.array([tunnel.nodes[name] for name in drift.nodes], dtype=np.float64)
    spans = np.linalg.norm(np.diff(nodes[:, :2], axis=0), axis=1)
    for (a, b), span in zip(pairwise(drift.nodes), spans, strict=True):
        if span < 2.0:
            raise ScenarioError(
                f"tunnel.nodes: {a!r} and {b!r} are {span:.2f} m apart: a drift needs 2 m between nodes"
            )
    is_shared = [uses[name] > 1 for name in drift.nodes]
    corners = _round_corners(nodes, spans, is_shared, section.width_m)
    points = resample(np.concatenate(corners), STEP_M)
    samples = _node_samples(nodes, corners, points)
    points = points + _meander(
        tunnel, index, points, [s for s, shared in zip(samples, is_shared, strict=True) if shared], seed
    )
    is_blind = (not is_shared[0], not is_shared[-1])
    extra = round(_BLIND_SHARE * section.width_m / STEP_M)
    is_extended = tunnel.mesh is None
    if is_blind[0] and is_extended:
        points = np.concatenate([_extension(points[1], points[0], extra)[::-1], points])
        samples = [sample + extra for sample in samples]
    if is_blind[1] and is_extended:
        points = np.concatenate([points, _extension(points[-2], points[-1], extra)])
    width_m, height_m = _sizes(tunnel, section, points, seed)
    return DriftLine(points, headings_of(points), section, width_m, height_m, tuple(samples), is_blind)


def _sizes(tunnel: Tunnel, section: Section, points: Float64Array, seed: int) -> tuple[Float64Array, Float64Array]:
    """Return width and height (N,) along a drift; both depend on the place alone, so drifts agree where they meet."""
    variation = tunnel.variation
    if variation is None or tunnel.mesh is not None:
        return np.full(len(points), section.width_m), np.full(len(points), section.height_m)
    keys = stream(seed, "tunnel", "variation").integers(2**63, size=2).tolist()
    limit = _VARIATION_LIMIT_SIGMA
    wander = [np.clip(noise_at(points[:, :2], variation.length_m, key), -limit, limit) for key in keys]
    shares = [np.maximum(1.0 + variation.share * each, _SMALLEST_SHARE) for each in wander]
    return section.width_m * shares[0], section.height_m * shares[1]


def _recess(
    niche: Niche, index: int, drifts: tuple[DriftLine, ...], edges: dict[tuple[str, str], tuple[int, int, int]]
) -> Recess:
    drift, first, last = edges[niche.between]
    line = drifts[drift]
    sample = round(first + niche.fraction * (last - first))
    if niche.height_m > line.height_m[sample]:
        raise ScenarioError(
            f"tunnel.niches[{index}].height_m = {niche.height_m:g}: higher than the drift, "
            f"{line.height_m[sample]:.2f} m there"
        )
    heading = line.headings[sample]
    outward = left_of(heading[None])[0] * (1.0 if niche.side == "left" else -1.0)
    back_m = line.width_m[sample] / 2 + niche.depth_m
    return Recess(drift, line.points[sample], heading, outward, float(back_m), niche.width_m, niche.height_m)


def _extension(inner: Float64Array, last: Float64Array, count: int) -> Float64Array:
    """Straight, level samples that continue from `inner` through `last`."""
    step = (last - inner) * (1.0, 1.0, 0.0)
    step *= STEP_M / np.linalg.norm(step)
    return np.asarray(last + np.arange(1, count + 1)[:, None] * step)


def _node_samples(nodes: Float64Array, corners: list[Float64Array], points: Float64Array) -> list[int]:
    """Return the sample nearest to each node, between the middles of the ways to its neighbours.

    A drift may come to one node twice, and pass near another one.
    """
    line = np.concatenate(corners)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    counts = np.array([len(corner) for corner in corners])
    at = along_m[np.cumsum(counts) - counts + counts // 2] / along_m[-1] * (len(points) - 1)
    bounds = [0, *((at[1:] + at[:-1]) / 2).astype(int).tolist(), len(points)]
    samples = [
        low + int(np.argmin(np.linalg.norm(points[low:high] - node, axis=1)))
        for node, (low, high) in zip(nodes, pairwise(bounds), strict=True)
    ]
    return [0, *samples[1:-1], len(points) - 1]


def _round_corners(
    nodes: Float64Array, spans: Float64Array, is_shared: list[bool], width_m: float
) -> list[Float64Array]:
    """Return the line at each node: a quadratic Bezier curve at a corner that belongs to this drift alone."""
    pieces = [nodes[:1]]
    parameter = np.linspace(0.0, 1.0, 33)[:, None]
    for i in range(1, len(nodes) - 1):
        if is_shared[i]:
            pieces.append(nodes[i : i + 1])
            continue
        reach_m = min(0.45 * spans[i - 1], 0.45 * spans[i], 2.0 * width_m)
        start = nodes[i] + (nodes[i - 1] - nodes[i]) * (reach_m / spans[i - 1])
        end = nodes[i] + (nodes[i + 1] - nodes[i]) * (reach_m / spans[i])
        pieces.append((1 - parameter) ** 2 * start + 2 * parameter * (1 - parameter) * nodes[i] + parameter**2 * end)
    pieces.append(nodes[-1:])
    return pieces


def _meander(tunnel: Tunnel, index: int, points: Float64Array, fixed: list[int], seed: int) -> Float64Array:
    """Return the sideways meander (N, 3) of a drift, zero at the samples `fixed` where it meets another drift."""
    if tunnel.meander_m == 0.0 or tunnel.mesh is not None:
        return np.zeros_like(points)
    along_m: Float64Array = np.arange(len(points), dtype=np.float64) * STEP_M
    key = int(stream(seed, "tunnel", "meander", str(index)).integers(2**63))
    # The spline's peaks reach about 2 standard deviations; meander_m is meant as the swing.
    wander_m = np.clip(0.5 * smooth_noise((along_m,), 0.5 * tunnel.meander_length_m, key), -1.0, 1.0) * tunnel.meander_m
    for sample in fixed:
        share = np.clip(np.abs(along_m - sample * STEP_M) / (0.5 * tunnel.meander_length_m), 0.0, 1.0)
        wander_m *= share**2 * (3.0 - 2.0 * share)
    return np.column_stack([left_of(headings_of(points)) * wander_m[:, None], np.zeros(len(points))])
