"""Modes that a subspace method leaves uncertain, decided by the likelihood of spectra."""
