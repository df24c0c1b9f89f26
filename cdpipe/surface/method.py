"""What a method of displacement is, and what it returns: ours and its rivals are of this kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cdpipe.core.geometry import Float64Array
from cdpipe.model.config import PipelineConfig
from cdpipe.surface.cells import NearReturns, SurfaceCells
from cdpipe.surface.places import SurfacePlaces

# 95 % of a normal distribution lie within this many standard deviations.
Z95 = 1.96


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Q displacements with their levels of detection.

    Attributes:
        displacement_m: (Q,) displacement, positive into the void; NaN where it was not measured.
        along_m: (Q,) the same along the normal of the before surface; of small displacements it is the same.
        level_m: (Q,) 95 % level of detection, NaN if unknown.
        shared_m: (Q,) part of the level that neighbours share, or one for all: their mean is no surer.
        after: Cells of the after session as the method laid them on the before session; None where it did not.
    """

    displacement_m: Float64Array
    along_m: Float64Array
    level_m: Float64Array
    shared_m: Float64Array | float = 0.0
    after: SurfaceCells | None = None


Method = Callable[[SurfaceCells, NearReturns, SurfacePlaces, Float64Array, PipelineConfig], Measured]
"""`method(before, after, places, chainage_m, config)` measures the displacement at every place."""
