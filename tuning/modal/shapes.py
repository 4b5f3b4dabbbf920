"""Mode shapes: comparison and complexity."""

import numpy as np
from jaxtyping import Complex, Float


def mac_matrix(
    first: Complex[np.ndarray, "mode channel"], second: Complex[np.ndarray, "other channel"]
) -> Float[np.ndarray, "mode other"]:
    """Modal assurance criterion |a^H b|^2 / (a^H a b^H b) of two sets of shapes (Allemang 2003).

    Components that are NaN were not measured: two shapes are compared where both were, and are not
    alike (0) if they nowhere were.
    """
    in_first, in_second = np.isfinite(first), np.isfinite(second)
    first, second = np.where(in_first, first, 0), np.where(in_second, second, 0)
    products = np.abs(first.conj() @ second.T) ** 2
    norms = (np.abs(first) ** 2 @ in_second.T) * (in_first @ np.abs(second.T) ** 2)
    return products / np.maximum(norms, 1e-300)


def phase_collinearity(shapes: Complex[np.ndarray, "mode channel"]) -> Float[np.ndarray, " mode"]:
    """Modal phase collinearity: 1 for components on a line of the complex plane, 0 on a circle.

    The squared ratio of difference and sum of the eigenvalues of the scatter matrix of real and
    imaginary parts (Pappa, Elliott and Schenk 1993, without their subtraction of the mean).
    """
    xx = np.sum(shapes.real**2, axis=1)
    yy = np.sum(shapes.imag**2, axis=1)
    xy = np.sum(shapes.real * shapes.imag, axis=1)
    return ((xx - yy) ** 2 + 4 * xy**2) / np.maximum((xx + yy) ** 2, 1e-300)


def normalised(shapes: Complex[np.ndarray, "mode channel"]) -> Complex[np.ndarray, "mode channel"]:
    """Shapes rotated to be as real as possible, with the largest component equal to one."""
    xx_yy = np.sum(shapes.real**2 - shapes.imag**2, axis=1)
    xy = np.sum(shapes.real * shapes.imag, axis=1)
    turned = shapes * np.exp(-0.5j * np.arctan2(2 * xy, xx_yy))[:, None]
    largest = np.take_along_axis(
        turned, np.argmax(np.abs(turned.real), axis=1)[:, None], axis=1
    ).real
    return turned / np.where(largest == 0, 1.0, largest)
