"""The simulated sensor held against recordings of a real one."""
