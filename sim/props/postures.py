"""How a prop is put down: upright, on its side, or tilted towards a wall."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from sim.props.shapes import Shape, solid_mesh

_LEAN_DEG = (10.0, 25.0)
# Farther than where the centre of mass stands over the foot, or a prop rocks back upright.
_BEYOND_BALANCE_DEG = 6.0
_STEEP_DEG, _STEEPEST_LEAN_DEG = 28.0, 40.0
_FOOT_M = 0.03
_ASKEW_DEG = 12.0  # of a tipped prop against lying square on a side


def start_rotation(name: str, shape: Shape, posture: str, seed: int) -> Float64Array:
    """Return the rotation (3, 3) in which a prop is put down before its yaw: none, or on a side that its name draws."""
    if posture == "upright" or not shape.is_settled:
        return np.eye(3)
    generator = stream(seed, "props", name, "tipped")
    axis = np.pi / 2 * generator.integers(4) + np.deg2rad(_ASKEW_DEG) * generator.uniform(-1.0, 1.0)
    return np.asarray(Rotation.from_rotvec(np.pi / 2 * np.array([np.cos(axis), np.sin(axis), 0.0])).as_matrix())


def tilted_towards(name: str, shape: Shape, wall: Float64Array, yaw_rad: float, seed: int) -> Float64Array:
    """Return the rotation (3, 3) of a prop that leans towards a wall in direction `wall` (2,).

    A flat one (a pallet) is stood on its longer edge first. Of its four sides it turns that one to the wall which is
    nearest to its yaw, or the next on which it leans more easily. It leans 10-25 degrees, or as far as it takes not to
    rock back upright.

    Raises:
        ScenarioError: It is too squat to lean.
    """
    size = np.array(shape.size_m)
    towards = float(np.arctan2(wall[1], wall[0]))
    stood = np.eye(3)
    if size[2] < 0.5 * size[:2].min():
        is_long_in_x = size[0] >= size[1]
        stood = Rotation.from_euler("x" if is_long_in_x else "y", np.pi / 2).as_matrix()
        yaw_rad = towards - (np.pi / 2 if is_long_in_x else 0.0)  # its thin side faces the wall
    nearest = round((yaw_rad - towards) / (np.pi / 2))
    lean_deg = stream(seed, "props", name, "leaning").uniform(*_LEAN_DEG)
    best, turned = np.inf, stood
    for quarter in (nearest, nearest - 1, nearest + 1, nearest + 2):
        rotation = (Rotation.from_euler("z", towards + quarter * np.pi / 2) * Rotation.from_matrix(stood)).as_matrix()
        balance_deg = _balance_deg(shape, rotation, wall)
        if balance_deg < best:
            best, turned = balance_deg, rotation
        if balance_deg < _STEEP_DEG:
            break
    lean_deg = max(lean_deg, best + _BEYOND_BALANCE_DEG)
    if lean_deg > _STEEPEST_LEAN_DEG:
        raise ScenarioError(
            f"prop {name!r} is too squat to lean against a wall: it would have to lean by {lean_deg:.0f} degrees, "
            f"{_STEEPEST_LEAN_DEG:g} is the most: make it slimmer, or choose another posture"
        )
    aside = np.array([-wall[1], wall[0], 0.0])
    return np.asarray(Rotation.from_rotvec(np.deg2rad(lean_deg) * aside).as_matrix() @ turned)


def _balance_deg(shape: Shape, rotation: Float64Array, wall: Float64Array) -> float:
    """Lean at which a prop's middle of mass stands over the edge of its foot on the side of the wall."""
    meshes = [solid_mesh(solid) for solid in shape.solids]
    hulls = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).convex_hull for mesh in meshes]
    weights = np.array([hull.volume for hull in hulls])
    middle = rotation @ (weights @ np.array([hull.center_mass for hull in hulls]) / weights.sum())
    corners = np.concatenate([mesh.vertices for mesh in meshes]) @ rotation.T
    low_m = float(corners[:, 2].min())
    foot = corners[corners[:, 2] < low_m + _FOOT_M, :2] @ wall
    return float(np.rad2deg(np.arctan2(foot.max() - middle[:2] @ wall, middle[2] - low_m)))
