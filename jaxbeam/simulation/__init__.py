"""Simulation of one case: integration plan, closed loop, record."""
