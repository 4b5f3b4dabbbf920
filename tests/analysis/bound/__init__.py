"""Tests of analysis.bound."""
