"""Programs: the flip, benchmarks, figures."""
