"""Scores of displacement fields: the places and windows that the harness chooses, and the figures over them."""
