"""Modes of several setups: sensors that move between records, and references that stay."""
