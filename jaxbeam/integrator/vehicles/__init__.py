"""Vehicles on the beam: their propagators, and their steps."""
