"""Engines behind one protocol: C MuJoCo, MuJoCo Warp, and closed-form systems."""
