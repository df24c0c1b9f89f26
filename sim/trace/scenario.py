"""A scenario along traced drifts: platform, routes, one box that is added; driven once to see that it can be."""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.files import dump_yaml
from cdpipe.core.names import visible
from cdpipe.core.progress import Progress, report_nothing
from scenarios.schema import Scenario
from sim.drive.trajectory import load_sensor, plan_trajectory
from sim.geometry.raycast import Caster
from sim.rock.axis import STATION_M
from sim.rock.centreline import Centreline, build_centreline
from sim.rock.grounding import set_on_floor
from sim.scene import build_world
from sim.trace.route import find_route
from sim.trace.spots import BoxSpot, find_spots
from sim.trace.tracing import Trace

_ROUTE_M = 200.0  # a pair of 200 m is simulated in a minute or two
_DRIVABLE_SLOPE = 0.36  # 20 degrees; on steeper floors a quadrotor flies
_WIDE_M = 7.0
_TRIES = 4
_SHARES, _EACH = (1.0, 0.6, 0.35), 2  # sizes of the box, and how many places of each size
_EASE = (1.0, 0.8, 0.6, 0.5)  # of the wanted clearance, try by try
_BOX_WIDTHS, _BOX_M = 0.14, (0.2, 0.9)
_MARGIN_M = 1.0  # left out at both ends of the route


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """A scenario about a traced mesh.

    Attributes:
        tree: The scenario as plain values, the path of the mesh as given.
        trouble: Why the simulator could not drive it; empty if it could.
    """

    tree: dict[str, Any]
    trouble: str

    @property
    def route(self) -> tuple[str, ...]:
        """Nodes of the route of both sessions."""
        return tuple(self.tree["before"]["route"])


def draft_scenario(found: Trace, on_progress: Progress | None = None) -> Draft:
    """Return a scenario along traced drifts, with a box that the simulator has placed and driven past.

    The box stands where the floor is most level. Where the walls leave the platform no room its clearance is lowered.

    Args:
        found: The traced drifts.
        on_progress: Receives "drive it", the number of the try and the number of tries.
    """
    tell = on_progress or report_nothing
    centreline = build_centreline(found.tunnel, 0)
    route = find_route(centreline, _ROUTE_M)
    first, trouble = None, ""
    for number, (spot, ease) in enumerate(_choices(found, centreline, route)):
        tell("drive it", number, _TRIES)
        tree = _tree(found, centreline, route, spot, ease)
        first = first or tree
        try:
            _drive(tree)
        except ScenarioError as error:
            trouble = trouble or str(error)
            continue
        tell("drive it", _TRIES, _TRIES)
        return Draft(tree, "")
    assert first is not None
    return Draft(first, trouble)


def format_scenario(draft: Draft, found: Trace, folder: Path) -> str:
    """Return a scenario as YAML, for a file in a folder; the path of the mesh starts there, links followed."""
    tree = {**draft.tree, "tunnel": dict(draft.tree["tunnel"])}
    path = Path(os.path.relpath(Path(found.file.path).resolve(), folder.resolve())).as_posix()
    tree["tunnel"]["mesh"] = {**tree["tunnel"]["mesh"], "path": path}
    head = [
        f"# Written by `tunnelcd trace`: {found.length_m:.0f} m of drift in {visible(Path(found.file.path).name)}.",
        "# Nodes lie on the floor, in the coordinates of the mesh (metres, z up). Change what you like, then run",
        "# `tunnelcd check` and `tunnelcd simulate`.",
    ]
    body = dump_yaml(tree, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
    return "\n".join([*head, *(f"# Note: {visible(note)}" for note in found.notes), body])


def _choices(found: Trace, centreline: Centreline, route: tuple[str, ...]) -> list[tuple[BoxSpot, float]]:
    """Return where the box may stand, and by what share the wanted clearance is taken: the best first."""
    width_m = min(centreline.edge(*edge)[1].width_m for edge in pairwise(route))
    side_m = float(np.clip(_BOX_WIDTHS * width_m, *_BOX_M))
    caster = Caster([found.mesh])
    grounded = set_on_floor(centreline, caster)
    spots = [spot for share in _SHARES for spot in find_spots(grounded, route, caster, share * side_m)[:_EACH]]
    spots.sort(key=lambda spot: not np.isfinite(spot.rough_m))  # of the sizes the largest over sound floor
    return list(zip(spots[:_TRIES], _EASE, strict=True))


def _drive(tree: dict[str, Any]) -> None:
    """Build the world and plan both drives.

    Raises:
        ScenarioError: It cannot be built or driven.
    """
    scenario = Scenario.model_validate({"family": "traced", **tree})
    world = build_world(scenario, 0)
    for session in ("before", "after"):
        plan_trajectory(world, scenario, load_sensor(scenario, session), 0, session)


def _tree(found: Trace, centreline: Centreline, route: tuple[str, ...], spot: BoxSpot, ease: float) -> dict[str, Any]:
    """Return the scenario with the box at a spot and a share of the wanted clearance."""
    sections = [centreline.edge(*each)[1] for each in pairwise(route)]
    width_m, height_m = min(each.width_m for each in sections), min(each.height_m for each in sections)
    wide_m = max(each.width_m for each in sections)
    kind = "ground_robot" if _steepest(found) <= _DRIVABLE_SLOPE else "quadrotor"
    up_m = min(0.8, 0.4 * height_m) if kind == "ground_robot" else min(2.0, 0.45 * height_m)
    clearance_m = ease * min(0.5, 0.16 * width_m, 0.3 * height_m)
    ends = {"start_m": _MARGIN_M, "end_m": _MARGIN_M}
    return {
        "description": f"{Path(found.file.path).stem}: a box appears; before and after drive the same way",
        "score_radius_m": 4.5 if wide_m < _WIDE_M else 10.0,
        "tunnel": _tunnel_tree(found),
        "props": [
            {
                "name": "box",
                "kind": "box",
                "size_m": [round(1.2 * spot.side_m, 2), round(spot.side_m, 2), round(spot.side_m, 2)],
                "place": {"between": list(spot.edge), "fraction": spot.fraction, "lateral": spot.lateral},
                "change": "added",
            }
        ],
        "platform": {
            "kind": kind,
            "sensor_height_m": round(up_m, 2),
            "clearance_m": round(clearance_m, 2),
            "scan_spacing_m": 0.5,
        },
        # a list for each: YAML would write one that both share as an anchor, and who edits one drive edits both
        "before": {"route": list(route), **ends, "lateral": 0.0},
        "after": {"route": list(route), **ends, "lateral": -0.2},
    }


def _tunnel_tree(found: Trace) -> dict[str, Any]:
    tunnel = found.tunnel.model_dump(mode="json", exclude_defaults=True)
    mesh = {"path": found.file.path, "units": found.file.units, "up": found.file.up, **tunnel["mesh"]}
    drifts = [
        {"nodes": list(drift.nodes)} | ({} if drift.section is None else {"section": _size(drift.section)})
        for drift in found.tunnel.drifts
    ]
    nodes = {name: [value + 0.0 for value in place] for name, place in found.nodes.items()}  # -0.0 is 0.0
    return {"mesh": mesh, "nodes": nodes, "drifts": drifts, "section": _size(found.tunnel.section)}


def _size(section: Any) -> dict[str, float]:
    return {"width_m": section.width_m, "height_m": section.height_m}


def _steepest(found: Trace) -> float:
    """Return the steepest slope of the drifts over 2 m, rise by run."""
    over = round(2.0 / STATION_M)
    slopes = [0.0]
    for drift in found.drifts:
        for middle in drift.middles:
            points = middle.points
            if len(points) > over:
                run_m = np.linalg.norm(points[over:, :2] - points[:-over, :2], axis=1)
                slopes.append(float(np.max(np.abs(points[over:, 2] - points[:-over, 2]) / np.maximum(run_m, 0.5))))
    return max(slopes)
