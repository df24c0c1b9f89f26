"""A run folder as reports read it: rows, cases, grids, and two runs beside one another."""
