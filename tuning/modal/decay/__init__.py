"""Modes of free decays: where they are in a log, and poles fitted to all of them together."""
