"""Tests of tuning.modal."""
