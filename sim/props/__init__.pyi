from .props import shape_of
from .rocks import passing_share, rock_mesh
from .shapes import Shape, Size, Solid, shape_mesh, solid_mesh

__all__ = [
    "Shape",
    "Size",
    "Solid",
    "passing_share",
    "rock_mesh",
    "shape_mesh",
    "shape_of",
    "solid_mesh",
]
