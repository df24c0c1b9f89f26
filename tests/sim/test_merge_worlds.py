"""Pairs of the plans of the merge as built: what their sessions share, and that disjoint ones share nothing."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, stream
from cdpipe.core.yamlfile import read_yaml
from cdpipe.sensor.ouster import SensorMetadata
from scenarios import library, load_scenario
from scenarios.schema import SessionPlan, Tunnel
from sim.drive.trajectory import plan_trajectory
from sim.geometry.mesh import Mesh
from sim.geometry.noise import noise_at
from sim.geometry.topology import closed_volume_m3
from sim.rock.centreline import Centreline, build_centreline, resample
from sim.scene import build_world

NEAR_M = 5.0
STEP_M = 0.5
SEEDS = range(10000, 10024)
COARSE = ("tunnel.resolution_m=0.45", "sensor.mode=512x10", "platform.scan_spacing_m=4")
CLEAN = ("merge/narrow", "merge/wide", "merge/network", "merge/cave", "merge/site1")


@pytest.fixture(scope="module", autouse=True)
def each_file_is_read_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "read_yaml", cache(read_yaml))
        yield


def line(centreline: Centreline, plan: SessionPlan) -> Float64Array:
    """Return the middle of the drifts (N, 3) along a session's way, half a metre apart."""
    points = np.concatenate([centreline.edge(a, b)[0][:-1] for a, b in pairwise(plan.route)])
    first, last = round(plan.start_m / STEP_M), round(plan.end_m / STEP_M)
    whole = resample(points, STEP_M)
    return whole[first : len(whole) - last]


def near_share(line_m: Float64Array, other_m: Float64Array) -> float:
    return float((cKDTree(other_m).query(line_m)[0] < NEAR_M).mean())


def overlap(name: str, seed: int) -> tuple[float, float]:
    """Return the share of the after way and of the shorter way within 5 m of the other."""
    scenario = load_scenario(name, seed)
    centreline = build_centreline(scenario.tunnel, seed)
    before, after = (line(centreline, plan) for plan in (scenario.before, scenario.after))
    of_after = near_share(after, before)
    return of_after, of_after if len(after) <= len(before) else near_share(before, after)


def test_clean_pairs_share_from_a_third_of_their_way_to_all_of_it() -> None:
    shares = np.array([overlap(name, seed) for name in CLEAN for seed in SEEDS])
    assert shares.min() > 0.28
    counts, _ = np.histogram(shares[:, 0], [0.0, 0.45, 0.6, 0.75, 0.9, 1.01])
    assert counts.min() >= 0.08 * len(shares)
    assert counts[-1] < 0.5 * len(shares)


def parts(mesh: Mesh) -> list[Mesh]:
    """Return the connected parts of a surface."""
    links = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(mesh.vertices),) * 2)
    n_parts, labels = connected_components(graph, directed=False)
    found = []
    for number in range(n_parts):
        renumber = np.cumsum(labels == number) - 1
        faces = renumber[mesh.faces[labels[mesh.faces[:, 0]] == number]]
        found.append(Mesh(mesh.vertices[labels == number], faces.astype(np.int32)))
    return found


@pytest.mark.parametrize(
    "name",
    ["smooth", *(pytest.param(name, marks=pytest.mark.soak) for name in ("narrow", "wide", "network", "cave"))],
)
def test_neither_session_reaches_anything_that_the_other_one_does(name: str, sensor: SensorMetadata) -> None:
    seed = 10003
    scenario = load_scenario(f"disjoint/{name}", seed, COARSE)
    world = build_world(scenario, seed)
    hollows = parts(world.before.meshes[0])
    volumes_m3 = [closed_volume_m3(hollow) for hollow in hollows]
    assert len(volumes_m3) == 2
    assert all(volume_m3 is not None and volume_m3 < 0 for volume_m3 in volumes_m3)  # closed, facing inwards

    directions = stream(seed, "test", "directions").normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    clouds = []
    for session, scene in (("before", world.before), ("after", world.after)):
        places = plan_trajectory(world, scenario, sensor, seed, session).world_T_sensor[:, :3, 3]
        origins = np.repeat(places, len(directions), axis=0)
        rays = np.tile(directions, (len(places), 1))
        ranges_m, _, _ = scene.caster.cast(origins, rays)
        assert np.isfinite(ranges_m).all()
        clouds.append(origins + ranges_m[:, None] * rays)
    nearest_m, _ = cKDTree(clouds[0]).query(clouds[1], distance_upper_bound=20.0)
    assert nearest_m.min() > 2 * NEAR_M
    inside = [[hollow.vertices.min(axis=0), hollow.vertices.max(axis=0)] for hollow in hollows]
    homes = {
        next(i for i, (low, high) in enumerate(inside) if ((cloud > low - 1e-3) & (cloud < high + 1e-3)).all())
        for cloud in clouds
    }
    assert homes == {0, 1}


def test_the_rock_of_the_second_drift_repeats_nothing() -> None:
    points = stream(3, "test", "places").uniform([0, -9, -3], [110, 9, 5], (4000, 3))
    for aside_m in (-400.0, -300.0, -200.0, 38.0):  # between the two drifts of any family
        here, there = (noise_at(points + np.array([0, shift_m, 0]), 1.5, key=12345) for shift_m in (0.0, aside_m))
        assert abs(np.corrcoef(here, there)[0, 1]) < 0.06


def test_the_meander_of_two_like_drifts_differs() -> None:
    nodes = {"a": (0, 0, 0), "b": (90, 0, 0), "far-a": (0, -300, 0), "far-b": (90, -300, 0)}
    drifts = ({"nodes": ("a", "b")}, {"nodes": ("far-a", "far-b")})
    tunnel = Tunnel.model_validate({"nodes": nodes, "drifts": drifts, "meander_m": 0.6})
    first, second = (drift.points for drift in build_centreline(tunnel, 5).drifts)
    assert len(first) == len(second)
    assert np.abs(first[:, 1] - (second[:, 1] + 300)).max() > 0.3
