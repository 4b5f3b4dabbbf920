"""Rigidity and mass per length of rig A, fitted to printed frequency responses of the shaker."""

import dataclasses
import functools

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.thesis.chapter2.shaker import OF_MASS, identified_beam
from jaxbeam import rigs
from tests.experiments.thesis import test_interpretations as equations


@pytest.fixture(scope="module")
def printed():
    return dataclasses.replace(rigs.load("A").beam, modes=4)


@pytest.fixture(scope="module")
def fitted(printed):
    return identified_beam(printed)


def test_one_figure_predicts_the_other(fitted):
    """The numbers with a mass, which were held out, within a unit of their last digits."""
    printed_numbers = np.concatenate([one.numbers for one in OF_MASS])
    units = np.concatenate([one.allowed_error for one in OF_MASS])
    assert_allclose(units, [1.0, 1.0, 0.1])
    assert np.all(np.abs(fitted.predicted - printed_numbers) <= units)


def test_the_fitted_beam_gives_all_ten_numbers_by_equations_in_scipy(fitted, monkeypatch):
    """Within a unit of their last digits, from eqs (2.26) to (2.34) written out."""
    rigidity, mass = fitted.values
    for name, value in (
        ("RIGIDITY", rigidity),
        ("DENSITY", mass),
        ("MODAL", mass * equations.LENGTH / 2),
    ):
        monkeypatch.setattr(equations, name, value)

    def size(frequency, on_beam=0.0):
        return abs(equations.force_per_volt(frequency, on_beam, 0.0))

    assert_allclose(size(1.0), 2.5, atol=0.1)
    for drop in (21.0, 84.0, 189.0, 340.0):
        _is_extreme_near(drop, size, -1.0)
    assert_allclose(_is_extreme_near(27.0, size, 1.0), 10.0, atol=1.0)
    with_mass = functools.partial(size, on_beam=0.5)
    _is_extreme_near(13.0, with_mass, -1.0)
    assert_allclose(_is_extreme_near(27.0, with_mass, 1.0), 32.5, atol=0.1)


def _is_extreme_near(frequency: float, size, sign: float) -> float:
    """Value of the extreme that is within 1 Hz of a frequency."""
    values = sign * np.array([size(f) for f in frequency + np.linspace(-1.0, 1.0, 401)])
    best = int(np.argmax(values))
    assert 0 < best < 400
    return sign * values[best]


def test_intervals_shrink_with_the_second_figure(printed, fitted):
    jointly = identified_beam(printed, jointly=True)
    assert np.all(np.diag(jointly.covariance) < np.diag(fitted.covariance))
    off = np.abs(jointly.values - fitted.values)
    assert np.all(off < 2 * np.sqrt(np.diag(fitted.covariance)))
    assert_allclose(jointly.predicted[2], 32.5, atol=0.1)
