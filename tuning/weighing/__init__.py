"""Weighing in motion: loads found in a log of a beam that is known."""
