"""A stand-in for the robot: MuJoCo behind the robot's own messages, with the faults of a real one."""
