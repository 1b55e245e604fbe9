"""The Unitree Go2: model, observation, stances, learned modes, and the flip as a task."""
