"""Sweeps of every quantity, beside one of deflections."""
