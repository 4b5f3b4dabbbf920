"""Stores of sweeps: blocks in zarr, which one process writes and all read, and in memory."""
