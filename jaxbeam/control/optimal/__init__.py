"""Linear-quadratic regulators."""
