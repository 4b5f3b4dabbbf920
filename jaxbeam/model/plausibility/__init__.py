"""Plausibility of a case before it runs: derived numbers, a table of their ranges, warnings."""
