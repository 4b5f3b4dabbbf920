"""Estimates of frequency responses to measured forces."""
