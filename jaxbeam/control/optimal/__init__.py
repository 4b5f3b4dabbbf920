"""Optimal."""
