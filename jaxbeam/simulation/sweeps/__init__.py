"""Sweeps: many runs of a case in batches and blocks, step sizes, store, cluster."""

MAX_RUNS = 10**9  # of a sweep; more exceed any memory
MAX_VALUES = 10**7  # of a range: each is a number of Python of its own
MAX_WORDS = 10**5  # combinations of words and counts: each is a case of its own
