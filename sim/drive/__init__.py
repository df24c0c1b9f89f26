"""Drives: the line of a robot, its movement over the floor, its odometry, and the poses of every revolution."""
