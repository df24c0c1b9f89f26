"""Measurements of the simulator itself: its speed, its worlds, its sensor."""
