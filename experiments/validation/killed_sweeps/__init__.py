"""Sweeps on a cluster whose processes are killed at random, on disks that are slow or full."""
