"""Many cases at once: batches, blocks, store, step size, cluster."""

MAX_RUNS = 10**9  # of a sweep: more would not fit into any memory
