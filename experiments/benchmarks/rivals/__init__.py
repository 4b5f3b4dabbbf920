"""The crossing of the speed benchmark solved by scipy, diffrax and numba."""
