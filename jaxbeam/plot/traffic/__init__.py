"""Loads in figures: parts of vehicles, their drawing and motion, rows of the figure of a run."""
