"""Tests of experiments.thesis."""
