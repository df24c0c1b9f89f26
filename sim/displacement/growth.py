"""Walls on their way from before to after: each change has happened in part, and two such states are a pair again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cdpipe.core.geometry import Float64Array
from sim.displacement.displace import MOVED_M, Displacement
from sim.displacement.refine import TwinWalls

CREEPING = ("convergence", "heave", "fill")  # kinds that may be half done; the others happen at once


def displace_between(whole: Displacement, start: Mapping[str, float], end: Mapping[str, float]) -> Displacement | None:
    """Return the walls of two states of a displacement, the first one as the before session.

    Every vertex lies on the straight way from its place before to its place after. The triangles are those of `whole`,
    so that the states of one scenario all share them.

    Args:
        whole: The walls before and after all changes.
        start: How much of each change has happened in the before session, by name, 0 to 1.
        end: The same of the after session.

    Returns:
        The two states; None where they are the same.
    """
    differing = [patch for patch in whole.patches if start[patch.name] != end[patch.name]]
    if not differing:
        return None
    walls = TwinWalls(_place(whole, start), _place(whole, end), whole.walls.faces, whole.walls.owner)
    moved_m = np.linalg.norm(walls.after - walls.before, axis=1)[walls.faces].max(axis=1)
    owner = walls.owner[walls.faces].max(axis=1)
    label = np.where(moved_m > MOVED_M, owner, 0).astype(np.int16)
    patches = tuple(replace(patch, is_undone=end[patch.name] < start[patch.name]) for patch in differing)
    original = walls.mesh("before") if any(start.values()) else whole.original
    return Displacement(walls, patches, label, moved_m > 0, original)


def _place(whole: Displacement, shares: Mapping[str, float]) -> Float64Array:
    """Return the places (N, 3) of the vertices; those of changes that are done or not begun are exact."""
    of_owner = np.zeros(1 + max(patch.number for patch in whole.patches))
    for patch in whole.patches:
        of_owner[patch.number] = shares[patch.name]
    share = of_owner[whole.walls.owner][:, None]
    before, after = whole.walls.before, whole.walls.after
    return np.where(share == 0.0, before, np.where(share == 1.0, after, before + share * (after - before)))
