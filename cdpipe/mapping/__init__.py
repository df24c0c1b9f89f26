"""Mapping: from the scans of one session to a voxel map with keyframes and their free space."""
