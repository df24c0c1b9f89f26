"""A view's surfaces as GLB (binary glTF), which Blender, browsers and game engines open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from sim.view.view import View

# glTF's y is up
_GLTF_T_WORLD = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def write_glb(view: View, path: Path) -> tuple[int, int]:
    """Write the walls, fixtures, props, movers, puddles and changed rock; return the number of meshes and triangles.

    A mesh has the name of its surface, `changes/added/box`, and the colour of its material at every vertex; a changed
    prop has the colour of its change. Paths, returns and labels are left out.

    Raises:
        OSError: The file cannot be written.
    """
    scene = trimesh.Scene()
    n_triangles = 0
    for surface in (*view.bands, *view.surfaces):
        mesh = trimesh.Trimesh(surface.mesh.vertices, surface.mesh.faces, process=False)
        linear = 255.0 * (np.array(surface.rgb) / 255.0) ** 2.2  # glTF 2.0, section 3.7.2.1: COLOR_0 is linear
        mesh.visual.vertex_colors = np.tile([*np.rint(linear), 255], (len(mesh.vertices), 1)).astype(np.uint8)
        scene.add_geometry(mesh, node_name=surface.name, geom_name=surface.name)
        n_triangles += len(mesh.faces)
    n_meshes = len(scene.geometry)
    scene.apply_transform(_GLTF_T_WORLD)
    path.write_bytes(scene.export(file_type="glb"))
    return n_meshes, n_triangles
