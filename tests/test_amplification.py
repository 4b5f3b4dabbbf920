"""Envelopes and dynamic amplification against the closed form of a moving force."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.amplification import amplification, envelope

LENGTH, RIGIDITY, DENSITY, FORCE = 0.6, 11.68, 0.535, 5.0
PLACES = np.array([0.15, 0.3, 0.4])


def crossing(speed: float, modes: int = 4) -> jb.Case:
    """A force over an undamped pinned beam, and some free vibration."""
    return jb.Case(
        jb.Beam(length=LENGTH, flexural_rigidity=RIGIDITY, mass_per_length=DENSITY, modes=modes),
        loads=[jb.MovingForce(force=FORCE, speed=speed)],
        run=jb.Run(duration=LENGTH / speed + 0.1),
    )


def exact(speed: float, times, modes: int = 4):
    """Deflection (time, place) on the beam: the classical series for a moving force."""
    j = np.arange(1, modes + 1)
    omega = (j * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / DENSITY)
    drive = j * np.pi * speed / LENGTH
    t = times[:, None]
    q = np.sin(drive * t) - drive / omega * np.sin(omega * t)
    q = -2 * FORCE / (DENSITY * LENGTH) * q / (omega**2 - drive**2)
    return q @ np.sin(j[:, None] * np.pi * PLACES / LENGTH)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_the_envelope_is_that_of_the_series(speed):
    times = np.linspace(0, LENGTH / speed, 200_001)
    expected = np.abs(exact(speed, times)).max(axis=0)
    found = np.asarray(envelope(crossing(speed), PLACES))
    # The largest deflection at these speeds comes while the force is on the beam.
    assert_allclose(found, expected, rtol=1e-7)


def test_a_slow_force_is_not_amplified_and_a_fast_one_is():
    middle = np.array([LENGTH / 2])
    static = FORCE * LENGTH**3 / (48 * RIGIDITY)
    fast = amplification(crossing(15.0), middle)
    assert_allclose(fast, envelope(crossing(15.0), middle) / static, rtol=1e-12)
    assert 1.6 < fast[0] < 1.8  # near its largest, at 0.62 of the critical speed
    assert_allclose(amplification(crossing(0.05, modes=6), middle), 1.0, atol=3e-3)
