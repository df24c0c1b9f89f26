"""People, and things as tall as people, sampled from the meshes of the simulation."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cdpipe.core.geometry import Float64Array, stream, transform
from cdpipe.extract.people import is_person
from scenarios.schema.props import Prop
from sim.geometry.mesh import Mesh
from sim.movers.body import Moment
from sim.movers.person import Person
from sim.props.props import shape_of
from sim.props.shapes import shape_mesh, solid_mesh

N_RETURNS = 6000
NOISE_M = 0.01


def sampled(meshes: list[Mesh], seed: int = 1) -> Float64Array:
    """Returns from the surfaces that are seen from the sides, with noise, one in ten mixed with a wall behind."""
    whole = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in meshes])
    rng = stream(seed, "sampled")
    points = np.asarray(trimesh.sample.sample_surface(whole, N_RETURNS, seed=seed)[0])
    points += rng.normal(0.0, NOISE_M, points.shape)
    mixed = rng.random(len(points)) < 0.1
    points[mixed, 0] += rng.uniform(0.0, 1.0, mixed.sum())
    return points


def person(height_m: float, time_s: float = 1.0) -> list[Mesh]:
    body, zero = Person(height_m, 0.0), np.zeros(1)
    poses = body.place_links(Moment(zero + time_s, zero, zero, zero, zero, zero))[:, 0]
    return [
        Mesh(transform(pose, mesh.vertices), mesh.faces)
        for link, pose in zip(body.links, poses, strict=True)
        for mesh in map(solid_mesh, link.solids)
    ]


@pytest.mark.parametrize("height_m", [1.6, 1.75, 1.95])
def test_who_stands_is_a_person(height_m: float) -> None:
    for time_s in (0.0, 1.0, 2.5):
        for seed in (1, 2):
            assert is_person(sampled(person(height_m, time_s), seed))


def test_a_person_from_head_to_thigh_alone_is_none_and_upside_down_neither() -> None:
    points = sampled(person(1.75))
    assert is_person(points[points[:, 2] > 0.3])  # feet hidden
    assert not is_person(points[points[:, 2] > 0.9])
    assert not is_person(points * (1.0, 1.0, -1.0))
    assert not is_person(points + 1.0 * (points[:, 2:] > 1.5) * (0.4, 0.0, 0.0))  # the head beside the chest
    assert not is_person(np.concatenate([points, points + np.array([0.0, 0.7, 0.0])]))  # two who stand side by side


@pytest.mark.parametrize("kind", ["box", "crate", "chair", "trolley", "barrel", "cone", "railing", "pallet", "rock"])
@pytest.mark.parametrize("height_m", [1.4, 1.6, 1.8])
def test_no_prop_of_the_same_size_is_a_person(kind: str, height_m: float) -> None:
    for width_m in (0.3, 0.5, 0.7):
        for depth_m in (0.2, 0.35):
            prop = Prop.model_validate({"name": "it", "kind": kind, "size_m": [width_m, depth_m, height_m]})
            for seed in range(8 if kind == "rock" else 1):
                assert not is_person(sampled([shape_mesh(shape_of(prop, seed))])), (width_m, depth_m, seed)
