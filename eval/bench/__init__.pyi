from .bench import contests, measure, write_table

__all__ = [
    "contests",
    "measure",
    "write_table",
]
