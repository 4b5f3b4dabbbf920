"""Timings against other solvers: each table from one command, by a written method."""
