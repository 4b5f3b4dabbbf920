"""Figures of results that an engineer signs."""
