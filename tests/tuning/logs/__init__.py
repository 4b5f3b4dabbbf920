"""Tests of tuning.logs."""
