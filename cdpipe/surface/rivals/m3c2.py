"""M3C2 (Lague, Brodu, Leroux 2013) and M3C2-EP (Winiwarter, Anders, Höfle 2021) at the places, extra `m3c2`.

Core points are the places, both clouds are the cells. M3C2 estimates its own normals in the before cells, at the scale
`m3c2.normal_m`; the normal of a place only says on which side the void is.
"""

from __future__ import annotations

from cdpipe.core.geometry import Float64Array
from cdpipe.methods.m3c2 import Distances, compare_clouds
from cdpipe.methods.m3c2_ep import detection_levels
from cdpipe.model.config import PipelineConfig
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells
from cdpipe.surface.method import Z95, Measured
from cdpipe.surface.places import SurfacePlaces


def measure_m3c2(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, config: PipelineConfig
) -> Measured:
    """Measure the displacement along the normals of M3C2; its level is that of the roughness of both surfaces.

    The level is equation (1) of the paper: 1.96 (sqrt(s_1^2 / n_1 + s_2^2 / n_2) + `m3c2.registration_m`).
    It is NaN where a cylinder holds too few cells. Arguments as of `Method`; the section `m3c2` is used.
    """
    found = _compare(before, after, places, config)
    shared_m = Z95 * config.m3c2.registration_m
    return Measured(-found.behind_m, -found.behind_m, found.levels_m + shared_m, shared_m)


def measure_m3c2_ep(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, config: PipelineConfig
) -> Measured:
    """Measure the displacement as `measure_m3c2`; its level is propagated from the errors of returns and alignment.

    A cell counts as one return, seen from the nearest pose of its session. Arguments as of `Method`; the sections
    `m3c2` and `m3c2_ep` are used.
    """
    found = _compare(before, after, places, config)
    path, after_path = (session.map_T_sensor[:, :3, 3] for session in (before, after))
    levels_m = detection_levels(places.points, path, after_path, found, config.m3c2_ep)
    return Measured(-found.behind_m, -found.behind_m, levels_m, Z95 * config.m3c2_ep.alignment_m)


def _compare(before: SurfaceCells, after: NearReturns, places: SurfacePlaces, config: PipelineConfig) -> Distances:
    return compare_clouds(places.points, places.normals, before.points, make_cells(after).points, config.m3c2)
