"""Validation of jaxbeam against independent sources, and of a version against another."""
