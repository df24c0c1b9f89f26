"""Placement of props: on the floor, clear of rock and of each other, settled by physics, with a way left for robots."""
