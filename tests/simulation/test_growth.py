"""Divergence is told by growth: random loops in any units, eigenvalues of scipy as the judge."""

import dataclasses

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integrator.inputs import growth_limit, largest_by_marks
from tests.loop_as_oracle import expected

DURATION, MODES = 4.0, 2  # s of a beam whose length, mass and stiffness are one
ACTUATOR, SENSOR, FORCE, DAMPING = 0.4, 0.3, 1.0, 0.02


@dataclasses.dataclass(frozen=True)
class Units:
    """Units of length (m), mass (kg) and time (s) in which the beam has the length one, and so on.

    All numbers of a case have the dimension of a product of their powers.
    """

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def case(self, gain: float, period: float | None, speed: float = 0.8) -> jb.Case:
        m, kg, s = self.length, self.mass, self.time
        return jb.Case(
            jb.Beam(m, kg * m**3 / s**2, kg / m, damping_ratio=DAMPING, modes=MODES),
            actuators=[jb.PointForce(ACTUATOR * m)],
            sensors=[jb.Sensor(SENSOR * m)],
            loads=[jb.MovingForce(force=FORCE * kg * m / s**2, speed=speed * m / s)],
            controller=jb.Feedback(
                [gain * kg / s**2], period=None if period is None else period * s
            ),
            run=jb.Run(DURATION * s, sample_rate=10 / s, gravity=m / s**2),
        )


def plant() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, b and c of the modes i of a pinned beam: sqrt(2) sin(i pi x), frequencies (i pi)^2."""
    orders = np.arange(1, MODES + 1)
    omega, size = (orders * np.pi) ** 2, 2 * MODES
    A, b, c = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for i, frequency in enumerate(omega):
        A[2 * i, 2 * i + 1] = 1.0
        A[2 * i + 1, 2 * i : 2 * i + 2] = -(frequency**2), -2 * DAMPING * frequency
    b[1::2], c[0::2] = (np.sqrt(2) * np.sin(orders * np.pi * x) for x in (ACTUATOR, SENSOR))
    return A, b, c


def growth(gain: float, period: float | None) -> float:
    """Logarithm of the growth of the fastest eigenvector over the run, by scipy."""
    A, b, c = plant()
    if period is None:
        return DURATION * float(scipy.linalg.eigvals(A - gain * np.outer(b, c)).real.max())
    held = scipy.linalg.expm(period * np.block([[A, b[:, None]], [np.zeros((1, 2 * MODES + 1))]]))
    loop = held[:-1, :-1] - gain * np.outer(held[:-1, -1], c)
    return DURATION / period * float(np.log(np.abs(scipy.linalg.eigvals(loop)).max()))


def check(gain: float, period: float | None, units: Units) -> str:
    """Check of one loop; returns what it does."""
    judged = growth(gain, period)
    record, unit = jb.simulate(units.case(gain, period)), jb.simulate(Units().case(gain, period))
    assert np.isnan(record.diverged_time) == np.isnan(unit.diverged_time)
    if np.isnan(record.diverged_time):
        assert judged < 30, judged
        assert_allclose(record.peak_deflection / units.length, unit.peak_deflection, rtol=1e-6)
        assert "diverges" not in record.verdict
        return "bounded" if judged < 0 else "slow"
    assert judged > 5, judged
    assert np.isnan(record.peak_deflection).all() and "diverges" in record.verdict
    assert np.isnan(record.lowest_contact_force).all()
    return "diverges"


@hypothesis.settings(derandomize=True, max_examples=12, deadline=None, database=None)
@hypothesis.given(
    gain=st.floats(-1e3, 1e5),
    period=st.floats(0.02, 0.2),
    powers=st.tuples(*[st.integers(-6, 6)] * 3),
)
def test_random_loops_in_any_units(gain, period, powers):
    check(gain, period, Units(*(10.0**power for power in powers)))


@pytest.mark.parametrize(
    ("gain", "period", "expected"),
    [
        (0.0, 0.05, "bounded"),
        (10.0, 0.05, "bounded"),
        (-200.0, 0.05, "diverges"),
        (1e5, 0.05, "diverges"),
    ],
)
def test_loops_of_each_kind(gain, period, expected):
    assert check(gain, period, Units(1e-3, 1e4, 1e2)) == expected


@pytest.mark.parametrize(("gain", "expected"), [(10.0, "bounded"), (-200.0, "diverges")])
def test_loops_in_continuous_time(gain, expected):
    assert check(gain, None, Units(1e3, 1e-2, 1e-1)) == expected


# A deflection a thousand times the length of the beam: E I in MN m^2, say.
SOFT = jb.replace(Units().case(0.0, 0.05), {"loads.0.force": 1e6})


def test_a_loop_without_gain_is_the_beam_without_a_loop():
    free = jb.simulate(dataclasses.replace(SOFT, controller=None))
    record = jb.simulate(SOFT)
    assert np.all(record.peak_deflection > 1e3)
    assert_allclose(record.peak_deflection, free.peak_deflection, rtol=1e-9)
    scale = np.abs(free.deflection).max()
    assert_allclose(record.deflection, free.deflection, rtol=0, atol=1e-9 * scale)
    assert record.verdict.split(";")[0] == free.verdict.split(";")[0]
    size = f"the deflection reaches {scale:.4g} m, {scale:.3g} times the length of the beam"
    assert size in record.verdict and size in free.verdict
    assert "stability of the loop" in record.verdict and "stability" not in free.verdict
    assert "times the length" not in jb.simulate(Units().case(0.0, 0.05)).verdict
    warned = (
        jb.check(SOFT).warnings, jb.check(dataclasses.replace(SOFT, controller=None)).warnings
    )  # fmt: skip
    assert warned[0] == warned[1] and "more than its length" in warned[0][-1]


def test_bounded_loops_beyond_the_length_by_the_oracle():
    case = jb.replace(
        dataclasses.replace(SOFT, loads=(jb.MovingForce(mass=1e5, speed=0.8),)),
        {"controller.gains.0": 30.0, "run.duration": 1.5, "run.gravity": 9.81},
    )
    times = np.linspace(0.1, 1.5, 8)
    found, truth = jb.simulate(case, times).command, expected(case, times).command
    assert_allclose(found, truth, rtol=0, atol=1e-6 * np.abs(truth).max())


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.sweeps.computation.FailedRunsWarning")
def test_sweeps_fail_where_the_loop_diverges_only():
    gains = np.array([0.0, 10.0, 1e5])
    runs = jb.sweep(SOFT, {"controller.gains.0": gains}, progress=False)
    assert runs.attrs["failed_runs"] == 1
    assert runs.failed.values.tolist() == [False, False, True]
    for gain, peak in zip(gains[:2], runs.peak_deflection.values[:2], strict=True):
        single = jb.simulate(jb.replace(SOFT, {"controller.gains.0": gain})).peak_deflection
        assert_allclose(peak, single, rtol=1e-6)


# What no one would call divergence, and what anyone would, as functions of time.
TIMES = np.linspace(0.0, 1.0, 4001)
BOUNDED = {
    "start": TIMES**6,
    "late start": np.maximum(TIMES - 0.24, 0) ** 3,
    "late load": 1e-7 + 10 * np.maximum(TIMES - 0.49, 0) ** 4,
    "steps": np.where(TIMES < 0.3, 1e-9, np.where(TIMES < 0.9, 1e-3, 1.0)),
    "vibration": np.abs(np.sin(40 * TIMES)),
    "decay": np.exp(-50 * TIMES),
    "nothing": 0 * TIMES,
}
GROWING = {"slow": 1e-3 * np.exp(25 * TIMES), "fast": 1e-3 * np.exp(200 * TIMES)}


@pytest.mark.parametrize("motion", BOUNDED | GROWING)
@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
def test_growth_of_given_motions(motion, unit):
    """The loads, as if all stood on the beam, have the amplitude 0.1."""
    amplitude = unit * (BOUNDED | GROWING)[motion][:, None]
    marks = 0.5 ** np.arange(12.0)
    limit = growth_limit(largest_by_marks(marks, TIMES, amplitude), np.array([0.1 * unit]))
    assert np.any(amplitude > limit) == (motion in GROWING)
