"""Sweeps: many runs of a case in batches and blocks, step sizes, store, cluster."""

MAX_RUNS = 10**9  # of a sweep; more exceed any memory
