"""Measurements of the simulator itself: figures of worlds, roughness of walls, charts of the sensor, speed."""
