"""Surface profiles of a road or track, one kind a file, with the interface of `base`."""
