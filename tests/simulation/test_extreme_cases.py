"""Runs with very heavy and very fast masses, and with very many modes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from experiments.benchmarks.rivals.baselines import PinnedBeam, reference_peaks
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.simulate import ContactLossWarning

MASS = 0.535 * 0.6  # of the beam, kg
CRITICAL = np.pi / 0.6 * np.sqrt(11.68 / 0.535)  # critical speed of the first mode, m/s


def reference_case(modes: int, mass: float, speed: float, **run) -> jb.Case:
    """Case of the reference solutions, with 0.5 s of free vibration."""
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        sensors=[jb.Sensor(x) for x in (0.15, 0.3, 0.45)],
        loads=[jb.MovingMass(mass=mass, speed=speed)],
        run=jb.Run(0.6 / speed + 0.5, **run),
    )


@pytest.mark.parametrize(("mass", "speed"), [(100 * MASS, 0.5), (0.05, 5 * CRITICAL)])
def test_heavy_and_fast_masses_agree_with_scipy(mass, speed):
    with pytest.warns(ContactLossWarning):
        record = jb.simulate(reference_case(3, mass, speed, sample_rate=200.0))
    expected = reference_peaks(PinnedBeam(3), [mass], [speed])[0, 0]
    assert_allclose(record.peak_deflection, expected, rtol=1e-6)
    assert "loses contact" in record.verdict


def test_slow_load_on_two_hundred_modes_is_near_statics():
    """The peak is at most that of a load applied suddenly, twice the static one."""
    case = jb.Case(
        jb.Beam(6.0, 1168.0, 5.35, damping_ratio=0.05, modes=200),
        sensors=[jb.Sensor(3.0)],
        loads=[jb.MovingMass(mass=0.5, times=[0.0, 0.2], positions=[2.99, 3.01])],
        run=jb.Run(0.2, sample_rate=100.0),
    )
    record = jb.simulate(case)
    assert np.isfinite(np.asarray(record.deflection)).all()
    assert record.peak_deflection[0] < 2.001 * static_peak(case, np.array([3.0]))[0]
