"""Modes after impacts that were not measured, from whole records."""
