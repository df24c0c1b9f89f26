"""Returns of a revolution on rock that moves: each goes along its own ray to the moved surface.

A return keeps its distance from the smooth surface: its ray, shifted by that distance along the normal, meets the
smooth surface where the rock of the return is. Between the two places where the shifted ray meets the surface as
recorded and as moved lies the way that the return goes. Only how it is rounded to a step of the ranges is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int64Array, invert, stream, transform
from sim.graft.part import Part, RecordedRevolution
from sim.graft.rock.patch import MARGIN_M, Patch, weigh
from sim.sensor.rays import Rays, revolution_rays
from sim.session.truth import Int16Array

FLATTEST_DEG = 80.0  # rays that meet the rock flatter than this stay as they are, and have no truth
NEAR_M = 0.5  # what lies off the rock, but no farther than this, may hang on it: it stays, and has no truth


@dataclass(slots=True, eq=False)
class RockCounts:
    """Returns of one session on each of P patches: those that moved, and those within it that stayed without truth."""

    moved: Int64Array
    left: Int64Array


@dataclass(frozen=True, slots=True, eq=False)
class RockTruth:
    """Displacement, metres, and surface change (R, W) of a revolution, as in `sim.session.truth`."""

    displacement: Float32Array
    surface_change: Int16Array

    def on_rock(self, is_rock: BoolArray) -> tuple[Float32Array, Int16Array]:
        """Return both, undefined and 0 off the rock."""
        displacement = np.where(is_rock, self.displacement, np.float32(np.nan))
        return displacement, np.where(is_rock, self.surface_change, np.int16(0))

    @classmethod
    def unmoved(cls, range_mm: npt.NDArray[np.uint32]) -> RockTruth:
        """Return displacement 0 for every return (R, W), NaN without one, and no change."""
        displacement = np.where(range_mm > 0, np.float32(0), np.float32(np.nan))
        return cls(displacement, np.zeros(range_mm.shape, np.int16))


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """Some returns of a revolution.

    Attributes:
        row, column: (N,) each pixel.
        origins, ways: (N, 3) float64 where its ray starts, and its direction, frame `patch`.
        reach_m: (N,) length of each ray.
    """

    row: Int64Array
    column: Int64Array
    origins: Float64Array
    ways: Float64Array
    reach_m: Float64Array

    @property
    def points(self) -> Float64Array:
        """(N, 3) their places."""
        return self.origins + self.reach_m[:, None] * self.ways

    def some(self, which: BoolArray | Int64Array) -> _Returns:
        """Return some of them."""
        pixels = self.row[which], self.column[which]
        return _Returns(*pixels, self.origins[which], self.ways[which], self.reach_m[which])


def move_rock(
    part: Part, revolution: RecordedRevolution, patches: Sequence[Patch], step_mm: int, counts: RockCounts, seed: int
) -> tuple[RecordedRevolution, RockTruth]:
    """Return a revolution with its returns on moved rock where the session is "after", and the truth of its returns.

    Args:
        part: The session.
        revolution: As recorded.
        patches: The rock that moves.
        step_mm: Ranges change by multiples of this.
        counts: Filled meanwhile.
        seed: Draws how shifts are rounded to steps.
    """
    sensor = part.source.sensor
    rays = revolution_rays(sensor, part.world_T_sensor[revolution.number] @ revolution.sensor_T_column)
    truth, range_mm = RockTruth.unmoved(revolution.range_mm), revolution.range_mm.copy()
    reach_m = np.where(range_mm > 0, range_mm / 1000.0 - sensor.beam_origin_m, 0.0)
    for patch in patches:
        found = _near(patch, rays, reach_m)
        if not len(found.row):
            continue
        where, further_m, moved_m, is_change, unknown = _meet(patch, found, is_after=part.name == "after")
        # rounded at random, so that the mean of a smooth displacement is right
        draw = stream(seed, part.name, "graft-rock", f"{revolution.number}-{patch.number}").random(len(further_m))
        steps = np.floor(further_m * 1000.0 / step_mm + draw).astype(np.int64) * step_mm
        range_mm[where] = np.maximum(range_mm[where].astype(np.int64) + steps, 1).astype(np.uint32)
        truth.displacement[where] = moved_m.astype(np.float32)
        truth.surface_change[where] = np.where(is_change, np.int16(patch.number), np.int16(0))
        truth.displacement[unknown] = np.nan
        counts.moved[patch.number - 1] += np.count_nonzero(is_change)
        counts.left[patch.number - 1] += len(unknown[0])
    return replace(revolution, range_mm=range_mm), truth


def _near(patch: Patch, rays: Rays, reach_m: Float64Array) -> _Returns:
    """Return the returns (R, W) whose rays pass through the ball about a patch, or end in it."""
    height = rays.directions.shape[1]
    middle = patch.world_T_patch[:3, 3]
    towards = middle - rays.origins
    along_m = np.einsum("whi,wi->hw", rays.directions, towards)
    aside_m2 = np.maximum((towards**2).sum(axis=1) - along_m**2, 0.0)
    radius_m = patch.radius_m + NEAR_M
    is_near = np.tile((aside_m2 < radius_m**2) & (along_m > -radius_m), (len(reach_m) // height, 1))
    row, column = np.nonzero(is_near & (reach_m > np.tile(along_m, (len(reach_m) // height, 1)) - radius_m))
    kept = reach_m[row, column] > 0
    row, column = row[kept], column[kept]
    patch_T_world = invert(patch.world_T_patch)
    ways = rays.directions[column, row % height].astype(np.float64) @ patch_T_world[:3, :3].T
    return _Returns(row, column, transform(patch_T_world, rays.origins[column]), ways, reach_m[row, column])


def _meet(
    patch: Patch, found: _Returns, *, is_after: bool
) -> tuple[tuple[Int64Array, Int64Array], Float64Array, Float64Array, BoolArray, tuple[Int64Array, Int64Array]]:
    """Return what a patch does to some returns.

    Returns:
        Row and column of the returns whose rock moves; by how much farther each lies now, displacement, and whether it
        belongs to the change, all (N,); and row and column of those without truth.
    """
    points = found.points
    half_m = np.array(patch.half_m) + MARGIN_M
    is_over = (np.abs(points[:, :2]) < half_m).all(axis=1)
    over = np.flatnonzero(is_over)
    off_m, normals = patch.heights.off_m(points[over])
    is_on, is_close = np.abs(off_m) <= patch.tolerance_m, np.abs(off_m) <= NEAR_M
    on = over[is_on]
    rock, off_m, normals = found.some(on), off_m[is_on], normals[is_on]
    cosine = -(rock.ways * normals).sum(axis=1)
    moves, is_hit, further_m, moved_m, is_change = _follow(patch, rock, off_m[:, None] * normals, cosine, is_after)
    is_flat = cosine < np.cos(np.deg2rad(FLATTEST_DEG))
    is_unknown = np.zeros(len(points), dtype=bool)
    is_unknown[on] = (moves & is_flat) | (~is_hit & (weigh(patch.change, rock.points[:, :2]) > 0))
    is_unknown[over[is_close & ~is_on]] = weigh(patch.change, points[over[is_close & ~is_on], :2]) > 0
    if is_after:
        hidden = np.setdiff1d(np.arange(len(points)), on)
        met_m = patch.bump.cast(found.origins[hidden], found.ways[hidden])[0]
        is_unknown[hidden] |= met_m < found.reach_m[hidden]
    kept = moves & is_hit & ~is_flat
    where = rock.row[kept], rock.column[kept]
    unknown = found.row[is_unknown], found.column[is_unknown]
    return where, further_m[kept], moved_m[kept], is_change[kept], unknown


def _follow(
    patch: Patch, rock: _Returns, off: Float64Array, cosine: Float64Array, is_after: bool
) -> tuple[BoolArray, BoolArray, Float64Array, Float64Array, BoolArray]:
    """Cast the rays of returns on the rock, shifted by `off` (N, 3) onto the smooth surface, at both surfaces.

    Returns:
        Whether the rock there moves; whether the ray meets both surfaces; by how much farther the return lies, 0 in the
        before session; its displacement; and whether it belongs to the change, all (N,).
    """
    deepest_m = float(np.linalg.norm(patch.walls.after - patch.walls.before, axis=1).max())
    back_m = np.minimum(0.9 * rock.reach_m, (0.05 + 1.5 * deepest_m) / np.maximum(cosine, 0.15))
    starts = rock.points - off - back_m[:, None] * rock.ways
    hits = [caster.faces(starts, rock.ways) for caster in patch.casters]
    met_m, face = (np.stack([hit[part] for hit in hits]) for part in (0, 2))
    is_hit: BoolArray = np.asarray((face >= 0).all(axis=0))
    own = int(is_after)
    moves = is_hit & (patch.is_moved[face[own]])
    further_m, moved_m = np.zeros(len(starts)), np.zeros(len(starts))
    places = starts[moves] + met_m[own, moves, None].astype(np.float64) * rock.ways[moves]
    moved_m[moves] = (patch.measure_after if is_after else patch.measure_before)(places)
    if is_after:
        further_m[moves] = met_m[1, moves].astype(np.float64) - met_m[0, moves]
    return moves, is_hit, further_m, moved_m, moves & patch.label[face[own]]
