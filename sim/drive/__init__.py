"""How the sensor moves: the robot's line, its ride along it, and what its odometry makes of it."""
