"""Sweeps of vehicles beside those of masses, and beside a script with scipy."""
