"""Poses of a session: estimated by odometry, checked, made consistent, and led back to the recorded frames."""
