"""Motion of beam and vehicles at the samples of a run, from states or in closed form."""
