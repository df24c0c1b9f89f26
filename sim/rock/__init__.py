"""The rock: centrelines, cross-sections, floor and roughness of drifts, their wall mesh, and foreign meshes."""
