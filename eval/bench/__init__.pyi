from .bench import list_contests, measure, write_table

__all__ = [
    "list_contests",
    "measure",
    "write_table",
]
