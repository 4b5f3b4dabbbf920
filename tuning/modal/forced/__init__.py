"""Modes and frequency responses where the force was measured."""
