"""Time to the first answer: rows of the benchmark, and how each is measured."""
