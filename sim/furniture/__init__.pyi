from .furniture import Fixture, furnish
from .stones import strew_stones

__all__ = [
    "Fixture",
    "furnish",
    "strew_stones",
]
