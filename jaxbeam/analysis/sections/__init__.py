"""Characteristic sections of a beam, and their influence lines."""
