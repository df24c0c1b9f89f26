"""What every stage stands on: errors, poses, motion, voxels, the spatial index and the YAML reader."""
