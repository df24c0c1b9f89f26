"""Meshes, noise fields, sweeps and ray casting: geometry that knows no tunnel."""
