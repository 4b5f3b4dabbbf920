"""Chapter 7: model predictive control of one and two spans with patches."""
