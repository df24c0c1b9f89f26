from .simulate import simulate_in_memory, simulate_pair
from .truth import read_labels

__all__ = [
    "read_labels",
    "simulate_in_memory",
    "simulate_pair",
]
