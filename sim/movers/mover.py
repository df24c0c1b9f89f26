"""A mover in its place: its body, its course, and the ray caster of each of its links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array
from scenarios.schema import Mover
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.materials import REFLECTIVITY
from sim.movers.body import Body, Extent, Reach, compile_links, compose_poses, measure_extent, measure_reach
from sim.movers.course import Course


@dataclass(frozen=True, slots=True, eq=False)
class Limb:
    """The surfaces of one link, in its frame.

    Attributes:
        meshes: One for each of its solids, as MuJoCo compiles them.
        caster: Ray caster over them, in this order.
        centre, radius_m: Ball around them, (3,) and metres.
    """

    meshes: tuple[Mesh, ...]
    caster: Caster
    centre: Float64Array
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """A body with its surfaces.

    Attributes:
        body: The body.
        limbs: The surfaces of each of its links.
        extent: How far it reaches over all its movement, straight on, root frame.
        reach: How far it reaches on lines that bend.
        materials: Material of each solid, link by link.
        reflectivity: (G,) share of light that each solid reflects.
    """

    body: Body
    limbs: tuple[Limb, ...]
    extent: Extent
    reach: Reach
    materials: tuple[str, ...]
    reflectivity: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class MovingBody:
    """A mover of one session.

    Attributes:
        mover: As the scenario has it.
        instance: Value of its returns in `instance`: the number of props, and its own number.
        figure: Its body.
        course: Where it is when.
    """

    mover: Mover
    instance: int
    figure: Figure
    course: Course

    def world_T_root(self, time_s: Float64Array) -> Float64Array:
        """Return the pose (T, 4, 4) of its root at times (T,) of the session."""
        return self.course.world_T_root(time_s)

    def world_T_links(self, time_s: Float64Array) -> Float64Array:
        """Return the pose (P, T, 4, 4) of each link at times (T,) of the session."""
        root_T_link = self.figure.body.place_links(self.course.moment(time_s))
        return compose_poses(self.world_T_root(time_s)[None], root_T_link)


def make_figure(body: Body, reflectivity: float | None) -> Figure:
    """Return a body with its surfaces; a reflectivity replaces those of its materials."""
    meshes = compile_links(body.links)
    materials = tuple(solid.material for link in body.links for solid in link.solids)
    shares = [reflectivity or REFLECTIVITY[material] for material in materials]
    limbs = tuple(_limb(of_link) for of_link in meshes)
    extent = measure_extent(body, meshes)
    reach = measure_reach(body, meshes, extent)
    return Figure(body, limbs, extent, reach, materials, np.array(shares, np.float32))


def _limb(meshes: list[Mesh]) -> Limb:
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return Limb(tuple(meshes), Caster(meshes), centre, float(np.linalg.norm(corners - centre, axis=1).max()))
