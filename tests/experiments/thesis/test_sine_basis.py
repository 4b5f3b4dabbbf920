"""Modes in a sine basis have the frequencies of Table 2.2, the spurious one included."""

import jax
import numpy as np
from numpy.testing import assert_allclose
from scipy.linalg import eigh

from experiments.thesis.chapter2.frequencies import sine_basis_modes
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, replace
from jaxbeam.model.modes import modes

# Table 2.2 of the thesis (section 2.1.1), frequencies in Hz of eight modes of two spans of 0.6 m.
ANALYTICAL = [20.387, 31.849, 81.550, 103.212, 183.488, 215.343, 326.2, 368.249]
APPROXIMATE = [20.387, 31.951, 81.550, 104.304, 183.487, 220.577, 326.198, 100660]
# Twenty sine modes, computed for this project by an independent implementation.
TWENTY = [20.387, 31.856, 81.550, 103.281, 183.487, 215.648, 326.198, 369.143]


def two_spans(count: int) -> Case:
    """The beam of Table 2.2, whose numbers belong to 11.68 N m^2 and 0.535 kg/m."""
    return Case(Beam(1.2, 11.68, 0.535, modes=count), supports=[Support(0.6)])


def test_approximate_frequencies_of_table_2_2_to_all_printed_digits():
    found = sine_basis_modes(two_spans(8)).frequencies
    assert_allclose(found[:7], APPROXIMATE[:7], rtol=0, atol=5.1e-4)
    assert_allclose(found[7], APPROXIMATE[7], rtol=0, atol=5)  # five digits: spurious


def test_analytical_frequencies_of_table_2_2_are_the_exact_ones():
    found = modes(two_spans(8)).frequencies
    # 11.68 and 0.535 are rounded, which changes frequencies by 0.002 Hz.
    assert_allclose(found, ANALYTICAL, rtol=0, atol=2.1e-3)


def test_twenty_sines_are_more_accurate():
    found = sine_basis_modes(two_spans(20)).frequencies
    assert_allclose(found[:8], TWENTY, rtol=0, atol=5.1e-4)
    exact = modes(two_spans(8)).frequencies
    assert np.all(found[:8] > exact * (1 - 1e-12))  # upper bounds, by Rayleigh and Ritz


def test_modes_are_those_of_the_matrix_of_sines():
    """Elastic and rotational springs, against the matrix written out by hand."""
    supports = [Support(0.4, 2e3, rotational_stiffness=3.0), Support(0.9, 5e4)]
    case = Case(Beam(1.2, 11.68, 0.535, modes=6), supports=supports)
    wave = np.pi * np.arange(1, 7) / 1.2
    size = np.sqrt(2 / (0.535 * 1.2))
    matrix = np.diag(11.68 / 0.535 * wave**4)
    for x, k, turn in ((0.4, 2e3, 3.0), (0.9, 5e4, 0.0)):
        shape, slope = size * np.sin(wave * x), size * wave * np.cos(wave * x)
        matrix += k * np.outer(shape, shape) + turn * np.outer(slope, slope)
    values, mix = eigh(matrix)
    found = sine_basis_modes(case)
    assert_allclose(found.stiffness, values, rtol=1e-11)
    x = np.linspace(0.0, 1.2, 50)
    expected = size * np.sin(np.outer(x, wave)) @ mix
    expected *= np.sign(expected[1])
    assert_allclose(found.shapes(x), expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_frequencies_are_differentiable():
    case = Case(Beam(1.2, 11.68, 0.535, modes=5), supports=[Support(0.5, 2e3)])

    def frequencies(k):
        return sine_basis_modes(replace(case, {"supports.0.stiffness": k})).frequencies

    difference = (frequencies(2001.0) - frequencies(1999.0)) / 2
    assert_allclose(jax.jacfwd(frequencies)(2000.0), difference, rtol=1e-6, atol=1e-12)
