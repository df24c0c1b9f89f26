"""An articulated body: rigid links, each of several solids, and the pose of each link at any moment of its movement.

Root frame: origin on the floor below the body, x forward, y left, z up. A curtain's root is the middle of its upper
edge. Angles turn about y, so a positive one turns x down and z forward.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import model_meshes
from sim.placement.settling import add_solid
from sim.props.shapes import Solid

# Moments at which a body's extent is measured, and what is added to it for the moments between them.
_SAMPLES = 96
_SPARE_M = 0.03
# Curvatures of a line at which the reach of what bends is measured; between them it is 1.5 cm off at most.
_BENDS_PER_M = np.linspace(-0.5, 0.5, 11)


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A rigid part.

    Attributes:
        name: Unique in its body.
        solids: Its primitives, link frame.
    """

    name: str
    solids: tuple[Solid, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """What a body does at T times.

    Attributes:
        time_s: (T,) time, the phase drawn by the seed included.
        way_m: (T,) distance from the end of the stretch at which it last turned round.
        activity: (T,) 1 while it moves, 0 while it stands, between them in the first and last steps of a stretch.
        turned: (T,) 0 on the way out, 1 on the way back, between them while it pauses.
        slope: (T,) rise of the floor per metre ahead of it.
        bend_per_m: (T,) curvature of its line, radians per metre, to the left positive.
    """

    time_s: Float64Array
    way_m: Float64Array
    activity: Float64Array
    turned: Float64Array
    slope: Float64Array
    bend_per_m: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """How far a body reaches over all moments of its movement, root frame.

    Attributes:
        low, high: (3,) corners of its bounding box, metres.
    """

    low: Float64Array
    high: Float64Array

    @property
    def centre(self) -> Float64Array:
        """(3,) middle of the box."""
        return np.asarray((self.low + self.high) / 2)

    @property
    def radius_m(self) -> float:
        """Radius of the ball around the box."""
        return float(np.linalg.norm(self.high - self.low)) / 2


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """How far a body reaches over all moments of its movement, by the curvature of its line, root frame.

    Attributes:
        bend_per_m: (K,) rising curvatures, to the left positive.
        low, high: (K, 3) corners of its bounding box there, metres.
    """

    bend_per_m: Float64Array
    low: Float64Array
    high: Float64Array

    def at(self, bend_per_m: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the low and the high corner (N, 3) of its box at curvatures (N,)."""
        low, high = (
            np.stack([np.interp(bend_per_m, self.bend_per_m, values) for values in corner.T], axis=-1)
            for corner in (self.low, self.high)
        )
        return low, high


class Body(ABC):
    """An articulated body.

    Attributes:
        links: Its rigid parts.
        period: Period of its movement in way (metres, for what walks) and in time (seconds); sampled for its extent.
        is_bending: Whether it bends with its line.
    """

    links: tuple[Link, ...]
    period: tuple[float, float]
    is_bending: bool = False

    @abstractmethod
    def place_links(self, moment: Moment) -> Float64Array:
        """Return root_T_link (P, T, 4, 4) of every link at T times."""


def sample_moments(body: Body, bend_per_m: float = 0.0) -> Moment:
    """Return moments over one period of a body, level, on a line that bends so, standing, moving and at either end."""
    share = np.arange(_SAMPLES) / _SAMPLES
    zero = np.zeros(3 * _SAMPLES)
    activity = np.repeat([0.0, 1.0, 1.0], _SAMPLES)
    turned = np.concatenate([share, np.zeros(_SAMPLES), np.ones(_SAMPLES)])
    time_s, way_m = np.tile(share, 3) * body.period[1], np.tile(share, 3) * body.period[0]
    return Moment(time_s, way_m, activity, turned, zero, zero + bend_per_m)


def measure_extent(body: Body, meshes: Sequence[Sequence[Mesh]], bend_per_m: float = 0.0) -> Extent:
    """Return how far a body reaches on a line that bends so, from the meshes of its links, each in the link's frame."""
    poses = body.place_links(sample_moments(body, bend_per_m))
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for of_link, root_T_link in zip(meshes, poses, strict=True):
        corners = np.concatenate([mesh.vertices for mesh in of_link])
        moved = corners @ np.swapaxes(root_T_link[:, :3, :3], 1, 2) + root_T_link[:, None, :3, 3]
        low, high = np.minimum(low, moved.min(axis=(0, 1))), np.maximum(high, moved.max(axis=(0, 1)))
    return Extent(low - _SPARE_M, high + _SPARE_M)


def measure_reach(body: Body, meshes: Sequence[Sequence[Mesh]], straight: Extent) -> Reach:
    """Return how far a body reaches on lines that bend, at least as far as straight on."""
    if not body.is_bending:
        return Reach(np.zeros(1), straight.low[None], straight.high[None])
    extents = [measure_extent(body, meshes, bend) for bend in _BENDS_PER_M.tolist()]
    low, high = np.stack([each.low for each in extents]), np.stack([each.high for each in extents])
    return Reach(_BENDS_PER_M, np.minimum(low, straight.low), np.maximum(high, straight.high))


def compile_links(links: Sequence[Link]) -> list[list[Mesh]]:
    """Return the surfaces of every link as MuJoCo compiles them, one mesh per solid, link frame.

    Each link is a mocap body of one model, at the identity. Its poses over time are those of `Body.place_links`.

    Raises:
        ScenarioError: A part has no size.
    """
    spec = mujoco.MjSpec()
    for link in links:
        body = spec.worldbody.add_body(name=link.name, mocap=True)
        for index, solid in enumerate(link.solids):
            add_solid(spec, body, solid, f"{link.name}/{index}", contype=0, conaffinity=0)
    try:
        model = spec.compile()
    except ValueError as error:
        raise ScenarioError(f"a mover is too small for its parts: {error}: give a larger size_m") from error
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    meshes = iter(model_meshes(model, data))
    return [[next(meshes) for _ in link.solids] for link in links]


def pitch_poses(angle_rad: Float64Array, x: Float64Array, y: float | Float64Array, z: Float64Array) -> Float64Array:
    """Return poses (T, 4, 4) turned by angles (T,) about y, at places (T,)."""
    cos, sin, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad), np.ones_like(angle_rad)
    rotation = np.stack([np.stack(row, -1) for row in ((cos, zero, sin), (zero, one, zero), (-sin, zero, cos))], -2)
    return make_pose(rotation, np.stack([x, np.broadcast_to(y, x.shape), z], axis=-1))


def compose_poses(a_T_b: Float64Array, b_T_c: Float64Array) -> Float64Array:
    """Return a_T_c (..., 4, 4).

    Written out by component: no library may split the sums differently from run to run.
    """
    product = [
        [sum(a_T_b[..., row, k] * b_T_c[..., k, column] for k in range(4)) for column in range(4)] for row in range(4)
    ]
    return np.stack([np.stack(row, axis=-1) for row in product], axis=-2)
