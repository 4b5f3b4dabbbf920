"""The speed benchmark's problem solved by scipy, diffrax and numba."""
