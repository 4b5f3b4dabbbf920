"""Peaks of what is monitored, in each step: rows, forces at its ends, and the largest so far."""
