"""What tools/bench.py measures: the engine, training and the planner."""
