"""Sweeps of high-speed trains over their speeds."""
