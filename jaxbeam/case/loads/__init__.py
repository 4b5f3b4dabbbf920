"""Loads, one kind a file, with the interface of `base`."""
