from .mesh import Mesh, NearSurface, box_mesh, cylinder_mesh, join_meshes, move_mesh
from .noise import noise_at, smooth_noise
from .raycast import Caster, measure_room, model_meshes
from .topology import closed_volume_m3, edges_of

__all__ = [
    "Caster",
    "Mesh",
    "NearSurface",
    "box_mesh",
    "closed_volume_m3",
    "cylinder_mesh",
    "edges_of",
    "join_meshes",
    "measure_room",
    "model_meshes",
    "move_mesh",
    "noise_at",
    "smooth_noise",
]
