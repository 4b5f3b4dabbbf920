"""Tests of experiments.benchmarks."""
