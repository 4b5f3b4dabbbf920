"""Wheels with mass over kinks, at which the slope of their path jumps: passages, and impulses."""
