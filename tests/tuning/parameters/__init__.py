"""Tests of tuning.parameters."""
