"""Foreign meshes: read from a file, converted to metres with z up, and checked for size and orientation."""

from __future__ import annotations

import itertools
import logging
import re
from pathlib import Path

import numpy as np
import trimesh

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array
from scenarios.schema import MeshFile
from scenarios.schema.tunnel import FARTHEST_M
from sim.geometry.mesh import Mesh, drop_flat_faces, drop_unused_vertices
from sim.geometry.topology import Edges, closed_volume_m3, edges_of, largest_hole, void_winding
from sim.rock.glb import count_glb

UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_UNIT_WORDS = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches", "ft": "feet"}
# rows: the world's axes in those of the file; y up as glTF has it
_WORLD_R_FILE = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
TUNNEL_KEY = "tunnel.mesh"
SUFFIXES = (".stl", ".obj", ".ply", ".glb")
MAX_TRIANGLES = 5_000_000
_MAX_BYTES = 2_000_000_000
_MAX_PARTS = 5_000  # trimesh takes 4 s for so many materials, and the square of it
_MAX_DEPTH = 64  # of nodes within nodes; trimesh walks up from each
_WELD_M = 1e-6
# What trimesh logs about a damaged file, tracebacks included, it also raises.
logging.getLogger("trimesh").addHandler(logging.NullHandler())
# trimesh names the place of each primitive of a GLB by six random digits, and of two equal names one part is lost: of
# 500 primitives in one file of 130, of 5,000 in every second one. Numbers in order are never equal.
_PLACES = itertools.count()
trimesh.util.unique_id = lambda length=12: f"place-{next(_PLACES):0{length}d}"
_MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
_MIN_THICKNESS_M = 1e-3
_TUNNEL_M = (2.0, 20_000.0)  # longest side
_DRIFT_M = (0.5, 60.0)  # four volumes by area: the diameter of a long tube
_PROP_M = (0.02, 15.0)  # longest side
_LIKELY_DRIFT_M = (1.6, 16.0)
_LIKELY_TUNNEL_M = (20.0, 5_000.0)
_LIKELY_PROP_M = (0.15, 6.0)


def tunnel_mesh(file: MeshFile) -> Mesh:
    """Return the walls of a foreign tunnel: metres, z up, in the coordinates of the file, facing into the void.

    Raises:
        ScenarioError: The file cannot be read, or is no surface that encloses a tunnel; one line with the way out.
    """
    mesh = read_mesh(file, TUNNEL_KEY)
    refuse_tunnel(mesh, file)
    return mesh


def refuse_tunnel(mesh: Mesh, file: MeshFile) -> None:
    """Refuse a surface that encloses no tunnel, or one whose file is scaled, far away, open or inside out.

    Raises:
        ScenarioError: One line with the way out.
    """
    key = TUNNEL_KEY
    edges = edges_of(mesh)
    volume_m3 = closed_volume_m3(mesh, edges)
    if volume_m3 is not None:
        area_m2 = trimesh.triangles.area(mesh.vertices[mesh.faces]).sum()
        across_m = 4.0 * abs(volume_m3) / float(area_m2)
        _refuse_length(f"its drifts are {_length(across_m)} across", across_m, file, key, _DRIFT_M, _LIKELY_DRIFT_M)
    _refuse_size(mesh, file, key, _TUNNEL_M, _LIKELY_TUNNEL_M)
    reach_m = float(np.abs(mesh.vertices).max())
    if reach_m > FARTHEST_M:
        raise ScenarioError(
            f"{key}: {file.path}: lies {reach_m / 1000:.0f} km from the origin, where millimetres are lost: "
            "move it near the origin, nodes and trajectories with it"
        )
    if len(edges.boundary) and not file.allow_open:
        around_m, middle = largest_hole(mesh, edges.boundary)
        raise ScenarioError(
            f"{key}: {file.path}: open: {len(edges.boundary)} edges have a face on one side only, the largest hole, "
            f"{_length(around_m)} around, is at {_place(middle)}: close it, "
            f"or let rays leave with {key}.allow_open: true"
        )
    refuse_disagreeing(mesh, file, edges)
    _refuse_facing_rock(mesh, file, key)


def refuse_disagreeing(mesh: Mesh, file: MeshFile, edges: Edges | None = None) -> None:
    """Refuse a surface some of whose faces are turned.

    Raises:
        ScenarioError: One line with the way out.
    """
    if len(wrong := (edges or edges_of(mesh)).disagreeing):
        raise ScenarioError(
            f"{TUNNEL_KEY}: {file.path}: at {len(wrong)} edges the two faces do not face the same way, first at "
            f"{_place(mesh.vertices[wrong[0]].mean(axis=0))}: make its normals consistent and export it again"
        )


def prop_mesh(file: MeshFile, name: str) -> Mesh:
    """Return the surface of a foreign prop: metres, z up, origin on the floor in the middle of the footprint.

    It need not be closed.

    Raises:
        ScenarioError: The file cannot be read, or is no object of a size that stands in a tunnel.
    """
    key = f"props.{name}.mesh"
    mesh = read_mesh(file, key)
    _refuse_size(mesh, file, key, _PROP_M, _LIKELY_PROP_M)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    _, _, axes = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), full_matrices=False)
    if np.ptp(mesh.vertices @ axes[2]) < _MIN_THICKNESS_M:
        raise ScenarioError(f"{key}: {file.path}: all in one plane: give it a thickness of {_MIN_THICKNESS_M:g} m")
    volume_m3 = closed_volume_m3(mesh)
    if volume_m3 is not None and volume_m3 < 0:
        raise ScenarioError(f"{key}: {file.path}: inside out: its faces face inwards: {_flip_hint(file, key)}")
    origin = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return Mesh(mesh.vertices - origin, mesh.faces)


def read_mesh(file: MeshFile, key: str) -> Mesh:
    """Return a file as one welded mesh, metres, z up, faces turned where `flip` asks for it.

    Args:
        file: The file, its units and its axes.
        key: The setting that names it, for messages.

    Raises:
        ScenarioError: The file cannot be read, or is too large; one line with the way out.
    """
    path = Path(file.path)
    say = f"{key}: {file.path}"
    if path.suffix.lower() not in SUFFIXES:
        raise ScenarioError(f"{say}: of an unknown kind: expected {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if not path.is_file():
        raise ScenarioError(f"{say}: no such file")
    size = path.stat().st_size
    if size == 0:
        raise ScenarioError(f"{say}: empty: export it again")
    if size > _MAX_BYTES:
        raise ScenarioError(f"{say}: {size / 1e9:.1f} GB: decimate it to {MAX_TRIANGLES:,} triangles at most")
    vertices, faces = _parse(path, say)
    if len(faces) == 0:
        raise ScenarioError(f"{say}: no triangles in it: cut short, or points and lines only? export a surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ScenarioError(f"{say}: a triangle names a vertex that is not there: export it again")
    is_bad = ~np.isfinite(vertices).all(axis=1)
    if is_bad.any():
        raise ScenarioError(f"{say}: {int(is_bad.sum())} vertices are not finite numbers: export it again")
    mesh = _weld(vertices @ _WORLD_R_FILE[file.up].T * UNIT_M[file.units], faces)
    if len(mesh.faces) == 0:
        raise ScenarioError(f"{say}: its triangles have no area at {_WELD_M * 1e6:g} micrometre: is units right?")
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])) if file.flip else mesh


def _parse(path: Path, say: str) -> tuple[Float64Array, Int64Array]:
    """Return all triangles of a file, its scene graph applied, in its own units and axes."""
    try:
        _refuse_contents(path, say)
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
        _refuse_scene(scene, say)
        solids = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        vertices = [np.asarray(solid.vertices, dtype=np.float64) for solid in solids]
        faces = [np.asarray(solid.faces, dtype=np.int64) for solid in solids]
    except ScenarioError:
        raise
    except Exception as error:  # the readers of trimesh let through whatever a damaged file provokes
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ScenarioError(f"{say}: unreadable, the file is damaged or of another kind ({reason})") from error
    if any(part.shape[1:] != (3,) for part in (*vertices, *faces)):
        raise ScenarioError(f"{say}: unreadable, the file is damaged: its vertices or its triangles are not of three")
    if not solids:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    starts = np.cumsum([0] + [len(part) for part in vertices])
    return np.concatenate(vertices), np.concatenate([part + at for part, at in zip(faces, starts[:-1], strict=True)])


def _refuse_contents(path: Path, say: str) -> None:
    """Refuse more parts than are read, and more triangles in a GLB, before trimesh makes a mesh of each part."""
    kind = path.suffix.lower()
    if kind == ".glb":
        found = count_glb(path)
        _refuse_numbers(found.parts, found.vertices, found.triangles, say)
    elif kind == ".obj":
        _refuse_numbers(len(set(re.findall(rb"usemtl [^\r\n]*", path.read_bytes()))), 0, 0, say)
    elif kind == ".stl":
        _refuse_numbers(len(re.findall(b"endsolid", path.read_bytes(), re.IGNORECASE)), 0, 0, say)


def _refuse_scene(scene: trimesh.Scene, say: str) -> None:
    """Refuse more parts and triangles than are read, before a copy is made of a part for each place it stands at."""
    nodes = scene.graph.nodes_geometry
    solids = [scene.geometry[scene.graph.transforms.node_data[node]["geometry"]] for node in nodes]
    n_vertices = sum(len(solid.vertices) for solid in solids)
    n_triangles = sum(len(solid.faces) for solid in solids if isinstance(solid, trimesh.Trimesh))
    _refuse_numbers(len(nodes), n_vertices, n_triangles, say)
    parents = scene.graph.transforms.parents
    for node in nodes:
        for _ in range(_MAX_DEPTH):
            node = parents.get(node)  # noqa: PLW2901 - a walk up
            if node in (None, scene.graph.base_frame):  # old trimesh makes the base its own parent
                break
        else:
            raise ScenarioError(f"{say}: nodes within nodes, deeper than {_MAX_DEPTH} levels: join its parts to one")


def _refuse_numbers(n_parts: int, n_vertices: int, n_triangles: int, say: str) -> None:
    if n_parts > _MAX_PARTS:
        raise ScenarioError(f"{say}: {n_parts:,} parts: join them to {_MAX_PARTS:,} at most")
    if n_triangles > MAX_TRIANGLES:
        raise ScenarioError(f"{say}: {n_triangles:,} triangles: decimate it to {MAX_TRIANGLES:,} at most")
    if n_vertices > 3 * MAX_TRIANGLES:
        raise ScenarioError(f"{say}: {n_vertices:,} vertices: decimate it to {3 * MAX_TRIANGLES:,} at most")


def _weld(vertices: Float64Array, faces: Int64Array) -> Mesh:
    """Merge vertices at the same place, and drop triangles without area and vertices without triangle."""
    keys = np.round(vertices / _WELD_M).astype(np.int64)
    # one number for the three is sorted ten times as fast; should two places ever share it, the slow way is taken
    mixed = (keys.astype(np.uint64) * _MIXERS).sum(axis=1, dtype=np.uint64)
    _, first, inverse = np.unique(mixed, return_index=True, return_inverse=True)
    if (keys[first[inverse]] != keys).any():
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return drop_unused_vertices(vertices[first], drop_flat_faces(inverse.reshape(-1)[faces]))


def _refuse_size(
    mesh: Mesh, file: MeshFile, key: str, allowed_m: tuple[float, float], likely_m: tuple[float, float]
) -> None:
    length_m = float(np.ptp(mesh.vertices, axis=0).max())
    _refuse_length(f"{_length(length_m)} long", length_m, file, key, allowed_m, likely_m)


def _refuse_length(
    what: str, length_m: float, file: MeshFile, key: str, allowed_m: tuple[float, float], likely_m: tuple[float, float]
) -> None:
    """Refuse a length outside the allowed ones, and name the units in which it is likely, the likeliest first."""
    if allowed_m[0] <= length_m <= allowed_m[1]:
        return
    middle_m = float(np.sqrt(likely_m[0] * likely_m[1]))
    lengths = {units: length_m / UNIT_M[file.units] * scale for units, scale in UNIT_M.items() if units != file.units}
    likely = [units for units, length in lengths.items() if likely_m[0] <= length <= likely_m[1]]
    likely.sort(key=lambda units: abs(np.log(lengths[units] / middle_m)))
    say = f"{key}: {file.path}: {what}"
    if not likely:
        raise ScenarioError(
            f"{say} in every unit known: expected {allowed_m[0]:g} to {allowed_m[1]:g} m: scale the file"
        )
    words = " or ".join(f"{_UNIT_WORDS[units]} ({_length(lengths[units])})" for units in likely)
    raise ScenarioError(f"{say}: is the file in {words}? set {key}.units: {' or '.join(likely)}")


def _refuse_facing_rock(mesh: Mesh, file: MeshFile, key: str) -> None:
    """Refuse a surface unless its faces, by the winding number in front of them, face what it encloses."""
    winding = void_winding(mesh)
    share = float((np.abs(winding + 1.0) < 0.5).mean())
    say = f"{key}: {file.path}"
    if share >= 0.8:
        return
    if float((np.abs(winding) < 0.5).mean()) >= 0.8:
        raise ScenarioError(
            f"{say}: inside out: its faces face into the rock: {_flip_hint(file, key)}"
            " (of a lining with a thickness keep the inner surface only)"
        )
    raise ScenarioError(
        f"{say}: {share:.0%} of its faces face into what it encloses: "
        "join its parts to one surface without inner faces, all facing the same way, and export it again"
    )


def _flip_hint(file: MeshFile, key: str) -> str:
    return f"leave {key}.flip out" if file.flip else f"set {key}.flip: true"


def _length(length_m: float) -> str:
    return f"{length_m:.3g} m" if length_m < 1000 else f"{length_m / 1000:.3g} km"


def _place(point: Float64Array) -> str:
    return f"({', '.join(f'{value:.1f}' for value in point)})"
