"""A small mine that the project grows, and the true centreline of its drifts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from scenarios.schema import Drift, Roughness, Section, Tunnel
from sim.rock.centreline import build_centreline
from sim.rock.tunnel import mesh_tunnel

WIDTH_M = 3.4


@dataclass(frozen=True)
class Mine:
    """A grown tunnel: its walls, and where its drifts run."""

    solid: trimesh.Trimesh
    line: npt.NDArray[np.float64]
    length_m: float


@pytest.fixture(scope="session")
def mine() -> Mine:
    """A drift that ends at both sides, and a loop off it that climbs: three junctions' worth of bends and two forks."""
    nodes = {
        "a": (0, 0, 0), "b": (16, 1, 0.4), "c": (36, -1, 0.2), "f": (50, 0, 0.5), "d": (17, 15, 2.2), "e": (34, 14, 2.0)
    }  # fmt: skip
    tunnel = Tunnel(
        nodes=nodes,
        drifts=(Drift(nodes=("a", "b", "c", "f")), Drift(nodes=("b", "d", "e", "c"))),
        section=Section(width_m=WIDTH_M, height_m=3.0),
        roughness=(Roughness(amplitude_m=0.1, length_m=2.0),),
        resolution_m=0.25,
    )
    centreline = build_centreline(tunnel, 3)
    walls = mesh_tunnel(tunnel, centreline, 3)
    solid = trimesh.Trimesh(walls.vertices, walls.faces, process=False)
    lines = [line.points for line in centreline.drifts]
    length_m = sum(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines)
    return Mine(solid, np.concatenate(lines), length_m)


@pytest.fixture(scope="session")
def tube() -> Callable[..., trimesh.Trimesh]:
    """A closed drift along x, 4 m wide and 3 m high, finely cut, facing inwards."""

    def make(length_m: float = 40.0) -> trimesh.Trimesh:
        solid = trimesh.creation.box(extents=(length_m, 4.0, 3.0)).subdivide_to_size(1.0)
        solid.apply_translation((length_m / 2, 0.0, 1.5))
        solid.invert()
        return solid

    return make


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[trimesh.Trimesh, str], str]:
    """Write a solid into the test's folder and return its path."""

    def save(solid: trimesh.Trimesh, name: str) -> str:
        solid.export(tmp_path / name)
        return str(tmp_path / name)

    return save
