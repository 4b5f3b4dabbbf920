"""Linear algebra, matrix equations and piecewise polynomials, without physics."""
