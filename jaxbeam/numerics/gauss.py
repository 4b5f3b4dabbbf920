"""Gauss-Legendre quadrature on [0, 1], and polynomials through values at its nodes."""

import functools

import numpy as np
from jaxtyping import Float


@functools.cache
def gauss_nodes(count: int) -> Float[np.ndarray, " node"]:
    """Nodes of the rule, which integrates polynomials of degree 2 count - 1 exactly."""
    return (np.polynomial.legendre.leggauss(count)[0] + 1) / 2


@functools.cache
def gauss_weights(count: int) -> Float[np.ndarray, " node"]:
    """Weights of the rule; their sum is 1."""
    return np.polynomial.legendre.leggauss(count)[1] / 2


@functools.cache
def lagrange_coefficients(count: int) -> Float[np.ndarray, "node power"]:
    """Monomial coefficients of the Lagrange polynomials of the nodes."""
    polynomials, nodes = [], gauss_nodes(count)
    for k, node in enumerate(nodes):
        others = np.delete(nodes, k)
        polynomials.append(np.polynomial.polynomial.polyfromroots(others) / np.prod(node - others))
    return np.array(polynomials)


@functools.cache
def integration_matrix(count: int) -> Float[np.ndarray, "node node"]:
    """Weights a_ij of the values at nodes j in the integral from 0 to node i."""
    nodes, powers = gauss_nodes(count), np.arange(1, count + 1)
    vandermonde = nodes[:, None] ** (powers - 1)
    return np.linalg.solve(vandermonde.T, (nodes[:, None] ** powers / powers).T).T
