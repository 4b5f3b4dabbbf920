"""Time, memory and place on disk of sweeps into a store, as they grow."""
