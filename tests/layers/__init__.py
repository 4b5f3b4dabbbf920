"""Layers of the tests: quick, daily, nightly; see `selection`."""
