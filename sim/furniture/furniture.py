"""The fixtures of both sessions: pipes, ducts, cable trays, markers, rock bolts and wire mesh.

Rays measure the wall that the fixtures follow, so foreign meshes can have them too. Each item and material is one
fixture over all drifts, which keeps the number of geoms small.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from scenarios.schema import Furniture, Tunnel
from sim.furniture.shell import measure_shell
from sim.furniture.support import BOLT_LOWEST_SHARE, SCREEN_LOWEST_SHARE, bolt_mesh, bolt_pins, screen_mesh
from sim.furniture.utilities import duct_meshes, marker_mesh, pipe_meshes, tray_meshes, wall_plans
from sim.geometry.mesh import Mesh, join_meshes
from sim.geometry.raycast import Caster
from sim.rock.axis import Axis, measure_axes
from sim.rock.centreline import Centreline

_PIN_SPACING_M = 1.2  # of the pins that hold a screen in a tunnel without bolts


@dataclass(frozen=True, slots=True, eq=False)
class Fixture:
    """A fixed surface of one material.

    Attributes:
        name: Unique in the tunnel, e.g. "pipe-1".
        material: Key of `sim.materials.REFLECTIVITY`.
        mesh: Its surface, world frame, metres, facing outwards.
    """

    name: str
    material: str
    mesh: Mesh


def furnish(tunnel: Tunnel, centreline: Centreline, walls: Caster, seed: int) -> tuple[Fixture, ...]:
    """Return the furniture of all drifts; empty if the tunnel has no furniture or no drifts.

    Args:
        tunnel: The tunnel; only its `furniture` is read.
        centreline: Its drifts.
        walls: Caster of the bare rock, facing into the void.
        seed: Seed of jitter, sag and panels.
    """
    furniture = tunnel.furniture
    if furniture == Furniture() or not centreline.drifts:
        return ()
    axes = measure_axes(centreline, walls)
    fixtures = (*_utilities(furniture, axes, seed), *_support(furniture, axes, seed))
    return tuple(fixture for fixture in fixtures if len(fixture.mesh.faces))


def _utilities(furniture: Furniture, axes: Sequence[Axis], seed: int) -> Iterator[Fixture]:
    plans = iter(wall_plans(furniture))
    for number, pipe in enumerate(furniture.pipes, start=1):
        yield Fixture(f"pipe-{number}", "steel", join_meshes(list(pipe_meshes(axes, pipe, next(plans)))))
    for number, duct in enumerate(furniture.ducts, start=1):
        name = f"duct-{number}"
        yield Fixture(name, "fabric", join_meshes(list(duct_meshes(axes, duct, name, seed))))
    for number, tray in enumerate(furniture.cable_trays, start=1):
        name = f"cable-tray-{number}"
        *steel, cables = tray_meshes(axes, tray, next(plans), name, seed)
        yield Fixture(name, "steel", join_meshes(steel))
        yield Fixture(f"cables-{number}", "rubber", cables)
    if furniture.markers is not None:
        yield Fixture("markers", "reflector", marker_mesh(axes, furniture.markers))


def _support(furniture: Furniture, axes: Sequence[Axis], seed: int) -> Iterator[Fixture]:
    bolts, screen = furniture.bolts, furniture.screen
    if bolts is None and screen is None:
        return
    shells = [measure_shell(axis, BOLT_LOWEST_SHARE) for axis in axes]
    spacing_m = _PIN_SPACING_M if bolts is None else bolts.spacing_m
    pins = [bolt_pins(shell, spacing_m, number, seed) for number, shell in enumerate(shells)]
    if bolts is not None:
        yield Fixture("bolts", "steel", bolt_mesh(shells, pins, bolts))
    if screen is not None:
        shells = [measure_shell(axis, SCREEN_LOWEST_SHARE) for axis in axes]
        yield Fixture("screen", "steel", screen_mesh(shells, pins, screen, seed))
