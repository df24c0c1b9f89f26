"""The graph of centrelines: the tunnel's nodes and drifts, corners rounded and the meander drawn."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float64Array, stream
from scenarios.schema import Drift, Section, Tunnel
from sim.noise import smooth_noise

STEP_M = 0.1
# Nodes are places where things may stand, so a blind drift goes on for half its width behind its last node.
_BLIND_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class DriftLine:
    """The centreline of one drift, at floor level, in the world frame.

    Attributes:
        points: (N, 3) samples about 0.1 m apart, metres.
        headings: (N, 2) unit direction of travel in the x-y plane.
        slopes: (N,) rise per metre of travel.
        section: Its cross-section.
        node_samples: Sample that stands for each node, in the drift's order.
        is_blind: Whether the line ends in rock at its start and at its end.
    """

    points: Float64Array
    headings: Float64Array
    slopes: Float64Array
    section: Section
    node_samples: tuple[int, ...]
    is_blind: tuple[bool, bool]


@dataclass(frozen=True, slots=True, eq=False)
class Centreline:
    """All drifts of a tunnel, and where the edge between two nodes lies."""

    drifts: tuple[DriftLine, ...]
    edges: dict[tuple[str, str], tuple[int, int, int]]

    def edge(self, start: str, end: str) -> tuple[Float64Array, Section]:
        """Return the (N, 3) centreline from one node to a neighbouring one, and the section there."""
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
    """Round the corners of every drift and add the meander that the seed draws.

    Raises:
        ScenarioError: Two neighbouring nodes of a drift coincide.
    """
    uses: dict[str, int] = {}
    for drift in tunnel.drifts:
        for node in drift.nodes:
            uses[node] = uses.get(node, 0) + 1
    drifts = tuple(_drift_line(tunnel, index, drift, uses, seed) for index, drift in enumerate(tunnel.drifts))
    edges: dict[tuple[str, str], tuple[int, int, int]] = {}
    for index, (drift, line) in enumerate(zip(tunnel.drifts, drifts, strict=True)):
        for (a, b), (first, last) in zip(pairwise(drift.nodes), pairwise(line.node_samples), strict=True):
            edges.setdefault((a, b), (index, first, last))
            edges.setdefault((b, a), (index, last, first))
    return Centreline(drifts, edges)


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


def _drift_line(tunnel: Tunnel, index: int, drift: Drift, uses: dict[str, int], seed: int) -> DriftLine:
    section = drift.section or tunnel.section
    nodes = np.array([tunnel.nodes[name] for name in drift.nodes], dtype=np.float64)
    spans = np.linalg.norm(np.diff(nodes[:, :2], axis=0), axis=1)
    for (a, b), span in zip(pairwise(drift.nodes), spans, strict=True):
        if span < 2.0:
            raise ScenarioError(
                f"tunnel.nodes: {a!r} and {b!r} are {span:.2f} m apart: a drift needs 2 m between nodes"
            )
    is_shared = [uses[name] > 1 for name in drift.nodes]
    points = resample(_round_corners(nodes, spans, is_shared, section.width_m), STEP_M)
    samples = [int(np.argmin(np.linalg.norm(points - node, axis=1))) for node in nodes]
    samples[0], samples[-1] = 0, len(points) - 1  # a closed loop has its first node at both ends
    points = points + _meander(
        tunnel, index, points, [s for s, shared in zip(samples, is_shared, strict=True) if shared], seed
    )
    is_blind = (not is_shared[0], not is_shared[-1])
    extra = round(_BLIND_SHARE * section.width_m / STEP_M)
    if is_blind[0]:
        points = np.concatenate([_extension(points[1], points[0], extra)[::-1], points])
        samples = [sample + extra for sample in samples]
    if is_blind[1]:
        points = np.concatenate([points, _extension(points[-2], points[-1], extra)])
    slopes = np.gradient(points[:, 2]) / np.maximum(np.linalg.norm(np.gradient(points[:, :2], axis=0), axis=1), 1e-9)
    return DriftLine(points, headings_of(points), slopes, section, tuple(samples), is_blind)


def _extension(inner: Float64Array, last: Float64Array, count: int) -> Float64Array:
    """Straight, level samples that continue from `inner` through `last`."""
    step = (last - inner) * (1.0, 1.0, 0.0)
    step *= STEP_M / np.linalg.norm(step)
    return np.asarray(last + np.arange(1, count + 1)[:, None] * step)


def _round_corners(nodes: Float64Array, spans: Float64Array, is_shared: list[bool], width_m: float) -> Float64Array:
    """Replace every corner that belongs to this drift alone by a quadratic Bezier curve."""
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
    return np.concatenate(pieces)


def _meander(tunnel: Tunnel, index: int, points: Float64Array, fixed: list[int], seed: int) -> Float64Array:
    """Sideways wander (N, 3) of a drift, zero at the samples `fixed` where it meets another drift."""
    if tunnel.meander_m == 0.0:
        return np.zeros_like(points)
    along_m: Float64Array = np.arange(len(points), dtype=np.float64) * STEP_M
    key = int(stream(seed, "tunnel", "meander", str(index)).integers(2**63))
    # The spline's peaks reach about 2 standard deviations; meander_m is meant as the swing.
    wander_m = np.clip(0.5 * smooth_noise((along_m,), 0.5 * tunnel.meander_length_m, key), -1.0, 1.0) * tunnel.meander_m
    for sample in fixed:
        share = np.clip(np.abs(along_m - sample * STEP_M) / (0.5 * tunnel.meander_length_m), 0.0, 1.0)
        wander_m *= share**2 * (3.0 - 2.0 * share)
    return np.column_stack([left_of(headings_of(points)) * wander_m[:, None], np.zeros(len(points))])
