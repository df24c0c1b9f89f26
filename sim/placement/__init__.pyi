from .arranging import place_props
from .contact import interpenetration_m, standing_surface
from .placing import Standing, Surroundings, floor_heights
from .recorded import check_inside, read_drive

__all__ = [
    "Standing",
    "Surroundings",
    "check_inside",
    "floor_heights",
    "interpenetration_m",
    "place_props",
    "read_drive",
    "standing_surface",
]
