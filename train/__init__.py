"""Training of the Go2's learned modes with rsl-rl."""
