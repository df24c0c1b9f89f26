"""The LiDAR: rays of a beam table, echoes, photons, noise, dropouts and false returns."""
