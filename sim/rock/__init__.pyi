from .axis import Axis, measure_axes
from .centreline import Centreline, DriftLine, build_centreline
from .foreign import prop_mesh, tunnel_mesh
from .tunnel import mesh_tunnel

__all__ = [
    "Axis",
    "Centreline",
    "DriftLine",
    "build_centreline",
    "measure_axes",
    "mesh_tunnel",
    "prop_mesh",
    "tunnel_mesh",
]
