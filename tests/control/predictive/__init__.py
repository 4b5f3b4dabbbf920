"""Tests of control.predictive."""
