"""Margins of loops with delays of several periods, against independent matrices."""

import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.analysis.margins import margins
from tests.loop_as_oracle import span_of

PERIOD, GAIN = 0.002, 200.0


def delayed_case(delay) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=2),
        actuators=[jb.Patch(0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.3)],
        controller=jb.Feedback([GAIN], period=PERIOD, delay=delay),
        run=jb.Run(1.0),
    )


def critical_gain(case: jb.Case, waiting: int) -> float:
    """Gain at which the loop with a delay of whole periods turns unstable."""
    span = span_of(case)
    n, slopes = span.modes, span.shapes(0.2575, 1) - span.shapes(0.3425, 1)
    lower = -np.hstack([np.diag(span.frequencies**2), span.damping])
    a = np.vstack([np.eye(n, 2 * n, k=n), lower])
    b = np.append(np.zeros(n), 8.292e-4 * 0.32 * 200.0 * slopes)[:, None]
    c = np.append(span.shapes(0.3), np.zeros(n))
    system = scipy.signal.cont2discrete((a, b, c[None], np.zeros((1, 1))), PERIOD)
    transition, force_response = np.asarray(system[0]), np.asarray(system[1])[:, 0]
    size = 2 * n + waiting  # delayed commands last, newest first
    closed_matrix = np.zeros((size, size))
    closed_matrix[: 2 * n, : 2 * n], closed_matrix[: 2 * n, -1] = transition, force_response
    closed_matrix[2 * n + 1 :, 2 * n : -1] = np.eye(waiting - 1)

    def excess(gain):
        closed_matrix[2 * n, : 2 * n] = -gain * c
        return np.abs(np.linalg.eigvals(closed_matrix)).max() - 1

    return scipy.optimize.brentq(excess, 0.0, 1e4)


@pytest.mark.parametrize("waiting", [1, 2, 5])
def test_gain_margin_with_delays_of_several_periods(waiting):
    """The states of the delay have a single eigenvector."""
    case = delayed_case(waiting * PERIOD)
    found = margins(linearised_loop(case, 0.0))
    assert_allclose(found.gain, critical_gain(case, waiting) / GAIN, rtol=1e-8)
