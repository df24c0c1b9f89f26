"""Stages composed from the truth, for upper bounds."""
