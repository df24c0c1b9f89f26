"""Geometry without tunnels: meshes, noise fields, sweeps, lines, and ray casting with Embree."""
