from .axis import Axis, measure_axes
from .centreline import Centreline, DriftLine, build_centreline
from .foreign import prop_mesh, read_mesh, refuse_tunnel, tunnel_mesh
from .grounding import set_on_floor
from .tunnel import mesh_tunnel

__all__ = [
    "Axis",
    "Centreline",
    "DriftLine",
    "build_centreline",
    "measure_axes",
    "mesh_tunnel",
    "prop_mesh",
    "read_mesh",
    "refuse_tunnel",
    "set_on_floor",
    "tunnel_mesh",
]
