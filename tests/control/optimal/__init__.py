"""Tests of control.optimal."""
