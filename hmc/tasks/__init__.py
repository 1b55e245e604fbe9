"""Ready-made tasks, each with modes, cost and simulator."""
