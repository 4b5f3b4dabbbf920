"""Tests of tuning.control."""
