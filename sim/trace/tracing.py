"""From the mesh to nodes and drifts: inside, skeleton, middle, nodes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.progress import Progress, report_nothing
from scenarios.schema import Drift, MeshFile, Section, Tunnel
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.geometry.topology import edges_of
from sim.rock.axis import find_nearest
from sim.rock.centreline import build_centreline
from sim.rock.foreign import TUNNEL_KEY, read_mesh, refuse_disagreeing, refuse_tunnel
from sim.trace.doubts import (
    is_inside_out,
    judge_roof,
    judge_width,
    refuse_far,
    refuse_turned,
    tell_parts,
    typical_width_m,
)
from sim.trace.graph import TracedDrift, join_drifts, name_nodes
from sim.trace.inside import Void, count_cells, find_inside
from sim.trace.middle import Middle, find_middle, is_steep
from sim.trace.rays import narrowest_chord_m
from sim.trace.skeleton import LEAST_STEP_M, Branch, count_uses, find_branches, join_through

_CELLS_ACROSS = (7.0, 4.0)  # of a drift: as many as this, where the grid is large no fewer than that
_MOST_CELLS = 10e6  # eight times as many are thinned
_CHORD_WIDTHS = 4.0
_PART_WIDTHS = 3.0  # a part shorter than this is a bubble
_TOLERANCES = (0.12, 0.06, 0.03)  # of the width, of the straight lines between nodes
_ASIDE = 0.2  # of the width, that the line of the simulator may lie beside the traced one
_ALIKE = 0.1  # sections that differ by less are one
_OF_OPTIONS = (  # what mistakes in a mesh are called: by the key of a scenario, and here, where nobody gave one
    (rf"^{re.escape(TUNNEL_KEY)}: ", ""),
    (rf"\bset {re.escape(TUNNEL_KEY)}\.units: ", "give --units "),
    (r"\bis units right\?", "are --units right?"),
)
Nodes = dict[str, tuple[float, float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """What was found in a mesh.

    Attributes:
        file: The mesh, `flip` and `allow_open` as it needs them.
        mesh: Its walls, world frame, facing the void.
        nodes: Places by name, on the floor.
        drifts: The drifts through them, the longest first.
        notes: What is odd, one line each.
    """

    file: MeshFile
    mesh: Mesh
    nodes: Nodes
    drifts: tuple[TracedDrift, ...]
    notes: tuple[str, ...]

    @property
    def length_m(self) -> float:
        """Length of all drifts."""
        return sum(drift.length_m for drift in self.drifts)

    @property
    def tunnel(self) -> Tunnel:
        """The tunnel of a scenario."""
        return _tunnel_of(self.file, self.nodes, self.drifts)


def trace_mesh(
    file: MeshFile, *, is_sure_of_units: bool = False, is_sure_of_up: bool = False, on_progress: Progress | None = None
) -> Trace:
    """Find the middle lines of the drifts of a mesh.

    Args:
        file: The mesh, its units and axes; `flip` and `allow_open` are found out.
        is_sure_of_units: Whether somebody named the units; a likelier one is then no matter of note.
        is_sure_of_up: Whether somebody named the axis that points up.
        on_progress: Receives the name of each step, its number and their number.

    Raises:
        ScenarioError: The file cannot be read, or holds no tunnel that can be traced; one line with the way out.
    """
    tell = on_progress or report_nothing
    tell("read the mesh", 0, 4)
    walls = _read_walls(file)
    notes = judge_width(walls.width_m, walls.file, is_sure_of_units)
    refuse_far(walls.mesh, walls.file)  # in wrong units it lies far away, too
    refuse_turned(walls.mesh, walls.file, is_sure_of_up)
    tell("find the inside", 1, 4)
    void = find_inside(walls.mesh, walls.caster, _choose_cell_m(walls))
    tell("thin it to lines", 2, 4)
    branches, steep = _drivable(find_branches(void, walls.width_at), walls.width_m)
    tell("move them to the middle", 3, 4)
    parts = _parts_of(_find_middles(branches, walls, void), walls)
    kept = [middle for part in parts for middle in part]
    notes += judge_roof(kept, walls.file)
    with _told_by_options():
        refuse_tunnel(walls.mesh, walls.file)
    nodes, drifts = _place_nodes(kept, walls)
    tell("move them to the middle", 4, 4)
    return Trace(walls.file, walls.mesh, nodes, tuple(drifts), (*notes, *tell_parts(parts), *steep))


@dataclass(frozen=True, slots=True, eq=False)
class _Walls:
    """A mesh that faces its void, with its rays, the file as it must be read, and the typical width of its drifts."""

    file: MeshFile
    mesh: Mesh
    caster: Caster
    width_m: float

    def width_at(self, point: Float64Array) -> float:
        """Return the width of the drift at a point (3,)."""
        return narrowest_chord_m(self.caster, point, _CHORD_WIDTHS * self.width_m)


def _read_walls(file: MeshFile) -> _Walls:
    """Read a mesh and turn it inside out where it faces the rock."""
    with _told_by_options():
        mesh = read_mesh(file.model_copy(update={"flip": False, "allow_open": True}), TUNNEL_KEY)
        refuse_disagreeing(mesh, file)
    caster = Caster([mesh])
    is_flipped = is_inside_out(mesh, caster)
    if is_flipped:
        mesh = Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))
        caster = Caster([mesh])
    is_open = len(edges_of(mesh).boundary) > 0
    file = file.model_copy(update={"flip": is_flipped, "allow_open": is_open})
    return _Walls(file, mesh, caster, typical_width_m(mesh, caster))


@contextmanager
def _told_by_options() -> Iterator[None]:
    try:
        yield
    except ScenarioError as error:
        told = str(error)
        for pattern, word in _OF_OPTIONS:
            told = re.sub(pattern, word, told)
        raise ScenarioError(told) from error


def _choose_cell_m(walls: _Walls) -> float:
    cell_m = walls.width_m / _CELLS_ACROSS[0]
    if (n_cells := count_cells(walls.mesh, cell_m)) > _MOST_CELLS:
        cell_m *= (n_cells / _MOST_CELLS) ** (1 / 3)
    if cell_m > walls.width_m / _CELLS_ACROSS[1]:
        x, y, z = np.ptp(walls.mesh.vertices, axis=0)
        raise ScenarioError(
            f"{walls.file.path}: {x:.0f} x {y:.0f} x {z:.0f} m are too much for drifts {walls.width_m:.2g} m across: "
            "cut it into parts and trace each"
        )
    return cell_m


def _drivable(branches: list[Branch], width_m: float) -> tuple[list[Branch], list[str]]:
    """Return the branches without shafts, and a note about these."""
    steep = [branch for branch in branches if is_steep(branch, width_m)]
    if not steep or len(steep) == len(branches):
        return branches, []
    x, y, z = (round(float(value)) for value in steep[0].points[len(steep[0].points) // 2])
    note = f"shafts or steps too steep to drive: {len(steep)} left out, the first at ({x}, {y}, {z})"
    return join_through([branch for branch in branches if not any(branch is each for each in steep)]), [note]


def _find_middles(branches: Sequence[Branch], walls: _Walls, void: Void) -> list[Middle]:
    uses = count_uses(branches)
    met = [(uses[branch.ends[0]] > 1, uses[branch.ends[1]] > 1) for branch in branches]
    return [
        find_middle(branch, walls.caster, void, walls.width_m, is_met)
        for branch, is_met in zip(branches, met, strict=True)
        if float(np.ptp(branch.points[:, :2], axis=0).max()) >= LEAST_STEP_M
    ]


def _parts_of(middles: Sequence[Middle], walls: _Walls) -> list[list[Middle]]:
    """Return the middles by part, the longest part first; bubbles are left out."""
    ends, places = np.unique(np.array([middle.ends for middle in middles]).reshape(-1, 2), return_inverse=True)
    pairs = places.reshape(-1, 2)
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(ends), len(ends)))
    _, part = connected_components(links, directed=False)
    found: dict[int, list[Middle]] = {}
    for middle, (first, _) in zip(middles, pairs, strict=True):
        found.setdefault(int(part[first]), []).append(middle)
    lengths_m = {label: sum(middle.length_m for middle in members) for label, members in found.items()}
    long = [label for label in found if lengths_m[label] > _PART_WIDTHS * walls.width_m]
    if not long:
        told = f"its line is {max(lengths_m.values(), default=0.0):.1f} m long, shorter than {_PART_WIDTHS:g} widths"
        raise ScenarioError(
            f"{walls.file.path}: no drift in it: {told} ({_PART_WIDTHS * walls.width_m:.1f} m): give a longer tunnel"
        )
    return [found[label] for label in sorted(long, key=lambda label: -lengths_m[label])]


def _place_nodes(middles: Sequence[Middle], walls: _Walls) -> tuple[Nodes, list[TracedDrift]]:
    """Return nodes and drifts with as many nodes as the simulator's lines need to stay near the middle."""
    chains = join_drifts(middles, walls.width_m)
    for tolerance in _TOLERANCES:
        nodes, drifts = name_nodes(chains, tolerance * walls.width_m)
        if _farthest_aside_m(nodes, drifts, walls.file) < _ASIDE * walls.width_m:
            break
    return nodes, drifts


def _farthest_aside_m(nodes: Nodes, drifts: Sequence[TracedDrift], file: MeshFile) -> float:
    """Return how far the lines that the simulator makes of nodes lie beside the traced ones at most."""
    lines = build_centreline(_tunnel_of(file, nodes, drifts), 0).drifts
    aside_m = [
        find_nearest(drift.points[:, :2], line.points[:, :2], np.inf)[0].max()
        for line, drift in zip(lines, drifts, strict=True)
    ]
    return float(max(aside_m))


def _tunnel_of(file: MeshFile, nodes: Nodes, drifts: Sequence[TracedDrift]) -> Tunnel:
    usual = _section_of(drifts[0])
    sections = [_section_of(drift) for drift in drifts]
    own = [None if _is_alike(section, usual) else section for section in sections]
    through = tuple(Drift(nodes=drift.nodes, section=section) for drift, section in zip(drifts, own, strict=True))
    return Tunnel(mesh=file, nodes=nodes, drifts=through, section=usual)


def _section_of(drift: TracedDrift) -> Section:
    return Section(width_m=round(drift.width_m, 1), height_m=round(drift.height_m, 1))


def _is_alike(section: Section, usual: Section) -> bool:
    pairs = ((section.width_m, usual.width_m), (section.height_m, usual.height_m))
    return all(abs(one - other) <= _ALIKE * other for one, other in pairs)
