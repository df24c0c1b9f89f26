"""Colours of rock that moved between the sessions: blue into the rock, red into the void, white for hardly at all."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.graft.rebuild import RockOutline
from sim.scene import WALL_GEOM, World
from sim.session.surface import MovedRock
from sim.view.returns import Rgb

# Displacements from which each colour holds, by magnitude; the same in every world, so that pictures compare.
STEPS_M = (0.005, 0.02, 0.05, 0.2)
_WHITE: Rgb = (245, 245, 245)
_RED: tuple[Rgb, ...] = ((253, 208, 188), (244, 144, 112), (214, 70, 56), (150, 12, 30))
_BLUE: tuple[Rgb, ...] = ((200, 222, 242), (130, 180, 222), (58, 122, 188), (12, 54, 128))
_LIGHT = 0.7  # share of the light that colours reflect in pictures, so that white is not overexposed
ROCK_RGB: tuple[Rgb, ...] = (*_BLUE[::-1], _WHITE, *_RED)  # by class: deepest into the rock first


def class_name(number: int) -> str:
    """Return what a class of displacement holds, in centimetres, e.g. `+2 to +5 cm`; positive into the void."""
    middle = len(STEPS_M)
    if number == middle:
        return f"less than {100 * STEPS_M[0]:g} cm"
    sign, rank = ("+" if number > middle else "-"), abs(number - middle)
    low = f"{sign}{100 * STEPS_M[rank - 1]:g}"
    return f"{low} cm and more" if rank == len(STEPS_M) else f"{low} to {sign}{100 * STEPS_M[rank]:g} cm"


def displacement_classes(world: World) -> Int64Array:
    """Return the class (M,) of every face of the after walls, an index of `ROCK_RGB`; -1 where no rock changed.

    The displacement of a face is that of its middle: exact, as in the truth. A face that is farther than 5 m from the
    before walls is of the last class of its change: nothing but a face advances so far, into the rock.
    """
    if world.displacement is None:
        return np.full(len(world.after.meshes[WALL_GEOM].faces), -1)
    wall = world.after.meshes[WALL_GEOM]
    faces = np.flatnonzero(world.displacement.label > 0)
    rock = MovedRock(world, world.displacement, "after")
    moved_m = rock.measure(wall.vertices[wall.faces[faces]].mean(axis=1), faces)
    moved_m = np.where(np.isfinite(moved_m), moved_m, -np.inf)
    found = np.full(len(wall.faces), -1)
    found[faces] = displacement_class(moved_m)
    return found


def displacement_class(moved_m: Float64Array) -> Int64Array:
    """Return the class of each of (N,) displacements, metres, positive into the void: an index of `ROCK_RGB`."""
    rank = np.searchsorted(STEPS_M, np.abs(moved_m), side="right")
    return np.asarray(len(STEPS_M) + np.where(moved_m < 0, -rank, rank), dtype=np.int64)


def outline_rgb(rock: RockOutline) -> Rgb:
    """Return the colour of a rock change of a grafted pair: that of its largest displacement."""
    return ROCK_RGB[int(displacement_class(np.array([rock.told.largest_m]))[0])]


def face_tints(world: World) -> Float64Array:
    """Return the linear RGB colour (M, 3) of every face of the after walls, NaN where no rock changed."""
    classes = displacement_classes(world)
    tints = _LIGHT * (np.array(ROCK_RGB) / 255.0) ** 2.2
    return np.asarray(np.where((classes >= 0)[:, None], tints[classes], np.nan))
