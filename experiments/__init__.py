"""Studies that stand on jaxbeam and tuning: what was published, done again, and benchmarks."""
