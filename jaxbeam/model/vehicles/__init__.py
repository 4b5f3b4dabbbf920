"""Vehicles as parts of linear systems: rows of contact, and names and starts of states."""
