"""Fits of a case to logs: datasets, least squares, results, validation, experiment design."""
