"""Where water stands: the level of each puddle, over the lowest place of the floor around its middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from scenarios.schema import Puddle, Scenario
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.placement.fitting import Spot
from sim.placement.placing import PROBE_UP_M, floor_heights
from sim.placement.stations import draw_areas, drawn_spots, spot_between, way
from sim.rock.centreline import Centreline, left_of

_SHEET_CORNERS = 48
_PROBE_M = 0.1  # between the places at which the floor is measured


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """A level disc of water, of which only the part above the floor is seen.

    Attributes:
        puddle: The puddle.
        centre: (3,) its middle at the level of the water, world frame, metres.
    """

    puddle: Puddle
    centre: Float64Array

    def sheet(self) -> Mesh:
        """Return the whole disc as a surface, world frame, facing up."""
        turn, corners = np.linspace(0.0, 2 * np.pi, _SHEET_CORNERS, endpoint=False), np.arange(_SHEET_CORNERS)
        rim = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(_SHEET_CORNERS)])
        faces = np.column_stack([np.zeros_like(corners), 1 + corners, 1 + np.roll(corners, -1)]).astype(np.int32)
        return Mesh(np.concatenate([[self.centre], self.centre + self.puddle.radius_m * rim]), faces)


def lay_puddles(scenario: Scenario, centreline: Centreline, walls: Caster, session: str, seed: int) -> tuple[Pool, ...]:
    """Return the pools of one session. A puddle of both sessions lies at one place in both.

    Args:
        scenario: Its puddles.
        centreline: The drifts.
        walls: The bare tunnel, the floor of which holds the water.
        session: "before" or "after".
        seed: Draws the place of a puddle across the drift, and along it where it is not given.

    Raises:
        ScenarioError: There is no floor under a puddle.
    """
    here = [puddle for puddle in scenario.puddles if puddle.sessions in ("both", session)]
    return tuple(_lay(puddle, scenario, centreline, walls, seed) for puddle in here)


def _lay(puddle: Puddle, scenario: Scenario, centreline: Centreline, walls: Caster, seed: int) -> Pool:
    generator = stream(seed, "pair", "puddle", puddle.name)
    drawn = float(generator.uniform(-1.0, 1.0))
    lateral = drawn if puddle.place.lateral is None else puddle.place.lateral
    spot = _find_spot(puddle, scenario, centreline, seed, generator)
    aside_m = lateral * max(spot.width_m / 2 - puddle.radius_m, 0.0)
    middle = spot.point.copy()
    middle[:2] += aside_m * left_of(spot.heading[None])[0]
    steps_m = np.arange(-puddle.radius_m, puddle.radius_m + _PROBE_M, _PROBE_M)
    grid = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= puddle.radius_m]
    probes = np.column_stack([middle[:2] + grid, np.full(len(grid), middle[2] + PROBE_UP_M)])
    floor_m = floor_heights(walls, probes)
    # a probe beyond the wall finds the floor of another level, or none
    is_near = np.abs(floor_m - middle[2]) < PROBE_UP_M
    if not is_near.any():
        raise ScenarioError(f"puddle {puddle.name!r}: there is no floor {spot.where}: give it another place")
    middle[2] = float(floor_m[is_near].min()) + puddle.depth_m
    return Pool(puddle, middle)


def _find_spot(
    puddle: Puddle, scenario: Scenario, centreline: Centreline, seed: int, generator: np.random.Generator
) -> Spot:
    """Return the place that a puddle names, or the first one that the seed draws."""
    place = puddle.place
    if place.between is not None and place.fraction is not None:
        return spot_between(place.between, place.fraction, centreline, over_humps=True)
    stations = way(scenario, centreline)
    if place.area is not None:
        stations = draw_areas(scenario, centreline, seed)[place.area][0]
    for spot in drawn_spots(generator, stations, scenario, centreline, over_humps=True):
        return spot
    raise ScenarioError(f"puddle {puddle.name!r}: no place on the way is free of junctions: give between and fraction")
