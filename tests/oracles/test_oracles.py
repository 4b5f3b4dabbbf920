"""Printed amplifications of a moving force, and the logs that the finite elements make.

All other oracles are tested where jaxbeam is: the two share no code, and agree.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.oracles import make_demo_log
from tests.oracles.closed_forms import (
    critical_speed,
    moving_force,
)
from tests.oracles.make_demo_log import DEMO, NOISE, SAMPLING, measure, truth
from tests.oracles.modal_equations import Span

SPAN = Span(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=5)


@pytest.mark.parametrize(
    ("ratio", "largest", "free"),  # first mode, over its static value; independent tables
    [
        (1 / 5, 1.0825318, 0.0),
        (1 / 3, 1.5, 0.0),
        (1 / 2, 3**0.5, 4 / 3),
        (1.0, np.pi / 2, np.pi / 2),
        (3 / 2, None, 6 / 5),
        (2.0, None, 2 * 2**0.5 / 3),
    ],
)
def test_the_closed_form_has_the_printed_amplifications(ratio, largest, free):
    speed = ratio * critical_speed(SPAN)
    crossing_time = SPAN.length / speed
    times = np.linspace(0.0, crossing_time, 20001)
    q, u = (np.array(c)[:, 0] for c in moving_force(SPAN, 1.0, speed, times))
    static = SPAN.shapes(0.3)[0] / SPAN.frequencies[0] ** 2
    if largest is not None:
        assert_allclose(np.abs(q).max() / static, largest, rtol=1e-7)
    amplitude = np.hypot(q[-1], u[-1] / SPAN.frequencies[0])
    assert_allclose(amplitude / static, free, rtol=1e-9, atol=1e-12)


# The committed demo logs are those that the finite-element model makes.


@pytest.mark.parametrize("name", SAMPLING)
def test_a_demo_log_is_small_and_has_units(name):
    path = DEMO / f"{name}.csv"
    assert path.stat().st_size < 60_000
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "time [s],d1 [mm],d2 [mm],d3 [mm]"


def test_making_the_demo_logs_again_gives_the_committed_numbers():
    for name, table in make_demo_log.make().items():
        committed = np.loadtxt(DEMO / f"{name}.csv", delimiter=",", skiprows=1)
        # Printed digits, and a little for another platform's last bits.
        np.testing.assert_allclose(table, committed, rtol=0, atol=0.51e-4)


def test_the_nominal_number_of_modes_is_enough_for_the_noise():
    """The error of the modes that the model neglects is far below the noise of a reading."""
    rig, logs = truth()
    few, many = (
        measure(rig, logs["log_2"]["loads"], *SAMPLING["log_2"], modes=modes)
        for modes in (rig["beam"]["modes"], make_demo_log.MODES)
    )
    assert np.abs(few - many).max() < 0.2 * NOISE
