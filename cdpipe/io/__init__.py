"""Reading and writing sessions, trajectories, point clouds and answers."""
