"""The size of a world before anything of it is built: what would take hours, or more memory than there is, is refused.

Measured: a triangle takes 0.65 kB while a world is built, a prop 0.2 s to be placed, 30 million triangles of wire mesh
ten minutes. A drive of 10 km under wire mesh of the usual opening is well within all bounds.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise

from cdpipe.core.errors import InputError, ScenarioError
from scenarios.schema import Scenario, Tunnel
from sim.furniture.support import BOLT_LOWEST_SHARE, SCREEN_LOWEST_SHARE, count_bolt_faces, count_screen_faces
from sim.rock.centreline import STEP_M, Centreline
from sim.rock.tunnel import count_wall_faces, require_buildable

_MOST_FACES = 30_000_000  # of furniture; as many as of rock (`sim.rock.tunnel`)
_FACES_PER_M = {"pipes": 51, "ducts": 107, "cable_trays": 102}
# The setting of what stands apart, and by what power of it fewer triangles make it larger.
_DISTANCES = {"bolts": ("spacing_m", 0.5), "screen": ("opening_m", 1.0)}
_BYTES_PER_FACE = 650
_MOST_PROPS = 3000  # ten minutes to place
_MOST_REVOLUTIONS = 100_000  # 25 km at the usual spacing; of 128 x 1024 pixels they take 150 GB
_ARC_SHARE = 0.75  # of a section's width and sides, of which a vault cuts the corners


def require_size(scenario: Scenario, centreline: Centreline) -> None:
    """Raise `ScenarioError` if rock, furniture, props or drives are more than is simulated; it names what to change."""
    require_buildable(scenario.tunnel, centreline)
    _require_furniture(scenario.tunnel, centreline)
    if len(scenario.props) > _MOST_PROPS:
        raise ScenarioError(f"props: {len(scenario.props)} of them: at most {_MOST_PROPS} are placed: repeat fewer")
    for session in ("before", "after"):
        _require_revolutions(scenario, session, centreline)


def require_memory(tunnel: Tunnel, centreline: Centreline) -> None:
    """Raise `InputError` if a world takes more memory than this machine has: the system would end the process."""
    if not hasattr(os, "sysconf"):
        return
    n_faces = sum(faces for _, faces in _count_furniture(tunnel, centreline)) + count_wall_faces(tunnel, centreline)
    wanted_gb = n_faces * _BYTES_PER_FACE / 1e9
    there_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    if wanted_gb > there_gb:
        raise InputError(
            f"tunnel: about {n_faces:.2g} triangles, which take {wanted_gb:.0f} GB of memory while they are built, and "
            f"this machine has {there_gb:.0f}: give a larger tunnel.resolution_m, less furniture or shorter drifts"
        )


def _require_furniture(tunnel: Tunnel, centreline: Centreline) -> None:
    faces = dict(_count_furniture(tunnel, centreline))
    if (n_faces := sum(faces.values())) <= _MOST_FACES:
        return
    name = max(faces, key=lambda each: faces[each])
    room = max(_MOST_FACES - (n_faces - faces[name]), _MOST_FACES / 2)  # the others may be too many as well
    way = "fewer of them"
    if name in _DISTANCES:
        key, power = _DISTANCES[name]
        least_m = getattr(getattr(tunnel.furniture, name), key) * (faces[name] / room) ** power
        way = f"{key} of at least {1.01 * least_m:.3g}"
    raise ScenarioError(
        f"tunnel.furniture.{name}: about {faces[name]:.2g} triangles on {_length_m(centreline):.0f} m of drift, and at "
        f"most {_MOST_FACES:.2g} are built: give {way}"
    )


def _length_m(centreline: Centreline) -> float:
    return sum(len(line.points) for line in centreline.drifts) * STEP_M


def _count_furniture(tunnel: Tunnel, centreline: Centreline) -> Iterator[tuple[str, float]]:
    """Yield about how many triangles each kind of furniture has, by the key of its setting."""
    furniture = tunnel.furniture
    for name, per_m in _FACES_PER_M.items():
        yield name, len(getattr(furniture, name)) * per_m * _length_m(centreline)
    if furniture.bolts is not None:
        yield "bolts", count_bolt_faces(furniture.bolts, _area_m2(centreline, BOLT_LOWEST_SHARE))
    if furniture.screen is not None:
        yield "screen", count_screen_faces(furniture.screen, _area_m2(centreline, SCREEN_LOWEST_SHARE))


def _area_m2(centreline: Centreline, lowest_share: float) -> float:
    """Return about how much roof and wall there is above a share of the height of all drifts."""
    return sum(
        len(line.points) * STEP_M
        * _ARC_SHARE * (line.section.width_m + 2 * (1 - lowest_share) * line.section.height_m)
        for line in centreline.drifts
    )  # fmt: skip


def _require_revolutions(scenario: Scenario, session: str, centreline: Centreline) -> None:
    plan, spacing_m = scenario.plan(session), scenario.of(session).platform.scan_spacing_m
    ends = [centreline.edges[edge][1:] for edge in pairwise(plan.route) if edge in centreline.edges]
    way_m = sum(abs(last - first) for first, last in ends) * STEP_M - plan.start_m - plan.end_m
    if way_m > _MOST_REVOLUTIONS * spacing_m:
        raise ScenarioError(
            f"{session}: platform.scan_spacing_m = {spacing_m:g}: {way_m / spacing_m:.2g} revolutions on {way_m:.0f} m "
            f"of way, and at most {_MOST_REVOLUTIONS} are recorded: at least {1.01 * way_m / _MOST_REVOLUTIONS:.3g}"
        )
