"""Actuators from logs: their hysteresis."""
