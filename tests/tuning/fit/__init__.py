"""Tests of tuning.fit."""
