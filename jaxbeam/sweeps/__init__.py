"""Many cases at once: batches, blocks, store, step size, cluster."""
