"""What runs on the robot: real-time code on numpy and the standard library alone."""
