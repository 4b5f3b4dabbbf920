"""Compiling, its cache, the optional C."""
