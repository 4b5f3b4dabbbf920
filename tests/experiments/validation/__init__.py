"""Tests of experiments.validation."""
