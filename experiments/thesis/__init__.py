"""Thesis."""
