"""Reproduction of a thesis, studies, validation and benchmarks with jaxbeam and tuning."""
