"""Logs of measured runs: files, units, faults, and their match with a case."""
