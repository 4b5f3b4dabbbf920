"""Poles, growth and Floquet multipliers against modal equations integrated by scipy."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize

import jaxbeam as jb
from jaxbeam.analysis import stability
from jaxbeam.analysis.frozen_loop import affine_jacobian, loop_dynamics
from jaxbeam.analysis.linearised_loop import (
    LinearisedLoop,
    affine_linearisations,
    linearised_loop,
    loop_timing,
)
from jaxbeam.analysis.stability import (
    _assignment,
    _tracked_branches,
    frozen_poles,
    growth,
    margins,
    stability_limit,
    stream,
)
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep
from jaxbeam.control.crossing_gains import GainSchedule
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.finite_horizon import GainTable
from tests.differences import central
from tests.modules import DATA

REFERENCE = json.loads((DATA / "optimal_control.json").read_text())
LENGTH, RIGIDITY, DENSITY, RATIO = 0.6, 11.68, 0.535, 0.03
SPRING, DAMPER, SHAKER_POSITION, BANDWIDTH = 12000.0, 80.0, 0.5, 1e4
MASS, SPEED = 0.509, 0.55


def shaker_case(controller, modes=3, force_per_volt=4.6, loads=None, sensors=1):
    beam = jb.Beam(
        length=LENGTH,
        flexural_rigidity=RIGIDITY,
        mass_per_length=DENSITY,
        damping_ratio=RATIO,
        modes=modes,
    )
    shaker = jb.Shaker(
        position=SHAKER_POSITION,
        stiffness=SPRING,
        damping=DAMPER,
        force_per_volt=force_per_volt,
        bandwidth=BANDWIDTH,
    )
    loads = [jb.MovingMass(mass=MASS, speed=SPEED)] if loads is None else loads
    return jb.Case(
        beam=beam,
        actuators=[shaker],
        sensors=[jb.Sensor(0.25)] * sensors,
        loads=loads,
        controller=controller,
        run=jb.Run(duration=1.4, sample_rate=500.0),
    )


def state_matrices(x, speed, mass, force_per_volt, modes=3):
    """State and input matrices in the sine basis, eqs (2.11) and (2.36) corrected.

    Of masses at one position or at several.
    """
    n = np.arange(1, modes + 1) * np.pi / LENGTH
    modal_mass = DENSITY * LENGTH / 2
    omega = n**2 * np.sqrt(RIGIDITY / DENSITY)
    shaker, angle = np.sin(n * SHAKER_POSITION), np.outer(x, n)
    weighted = (np.reshape(mass, (-1, 1)) * np.sin(angle)).T
    M = modal_mass * np.eye(modes) + weighted @ np.sin(angle)
    C = modal_mass * np.diag(2 * RATIO * omega) + DAMPER * np.outer(shaker, shaker)
    C += 2 * speed * weighted @ (n * np.cos(angle))
    K = modal_mass * np.diag(omega**2) + SPRING * np.outer(shaker, shaker)
    K -= speed**2 * weighted @ (n**2 * np.sin(angle))
    A = np.zeros((2 * modes + 1,) * 2)
    A[:modes, modes:-1] = np.eye(modes)
    A[modes:-1, :modes] = -np.linalg.solve(M, K)
    A[modes:-1, modes:-1] = -np.linalg.solve(M, C)
    A[modes:-1, -1] = np.linalg.solve(M, shaker)
    A[-1, -1] = -BANDWIDTH
    B = np.zeros((2 * modes + 1, 1))
    B[-1] = BANDWIDTH * force_per_volt
    return A, B


def regulator(**options):
    weights = [1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0]
    return jb.LQR(
        state_weight=weights, command_weight=[9e-5], coordinates="sine",
        design=DesignModel(force_per_volt=4.6), **options,
    )  # fmt: skip


def test_frozen_poles_of_published_regulator():
    case = shaker_case(regulator())
    times = np.array([0.05, 0.25, 0.44]) / SPEED
    found = frozen_poles(case, times)
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6)
    Q = np.diag([1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0])
    P = scipy.linalg.solve_continuous_are(A, B, Q, [[9e-5]])
    for i, t in enumerate(times):
        A, _ = state_matrices(SPEED * t, SPEED, MASS, 4.6)
        poles = np.linalg.eigvals(A - B @ B.T @ P / 9e-5)
        np.testing.assert_allclose(
            np.sort_complex(found.poles[i]), np.sort_complex(poles), rtol=1e-7
        )
    printed = REFERENCE["frozen_closed_loop_poles_time_invariant_all_states_mass_at_0.25m"]
    printed = np.array([complex(*pole) for pole in printed])
    np.testing.assert_allclose(np.sort_complex(found.poles[1]), np.sort_complex(printed), rtol=1e-6)
    assert found.largest_real_part[2] == pytest.approx(found.poles[2].real.max())


def test_frozen_poles_with_a_gain_that_varies_compile_nothing():
    """The commands of known gain tables are known, so that no frozen position is compiled."""
    case = shaker_case(regulator())
    loop = loop_dynamics(case, mesh_layout(case))
    coefficients = np.random.default_rng(0).normal(size=(3, 4, 1, 7))
    breakpoints, none, end = np.array([0.0, 0.2, 0.7, 1.0]), np.zeros((1, 7)), LENGTH / SPEED
    table = GainTable(breakpoints, coefficients)
    schedule = GainSchedule(table, none, np.zeros(0), np.array(0.0), np.array(end))
    loop = eqx.tree_at(lambda x: x.law.law, loop, schedule)
    times = np.array([0.1, 0.5, 0.9]) * end
    frozen = affine_linearisations(loop, None, times)
    for i, (t, found) in enumerate(zip(times, frozen, strict=True)):
        A, B = state_matrices(SPEED * t, SPEED, MASS, 4.6)
        start, length = breakpoints[i], breakpoints[i + 1] - breakpoints[i]
        gain = np.polyval(coefficients[i, ::-1], (t / end - start) / length)
        gain[:, -1] /= 4.6  # of the force of the shaker, not of its voltage
        expected = np.linalg.eigvals(A - B @ gain)
        np.testing.assert_allclose(
            np.sort_complex(found.poles()), np.sort_complex(expected), rtol=1e-7
        )


@pytest.mark.parametrize("period", [None, 0.01])
def test_derivatives_of_the_growth_rate_by_gains(period):
    """Against differences of the eigenvalues by NumPy."""
    rng = np.random.default_rng(6)
    A, B, gains = rng.normal(size=(5, 5)), rng.normal(size=(5, 2)), rng.normal(size=10)

    def rate(gains):
        return LinearisedLoop(A, B, gains.reshape(2, 5), period, 4).growth_rate()

    def by_numpy(gains):
        values = np.linalg.eigvals(A + B @ gains.reshape(2, 5))
        return max(values.real) if period is None else np.log(max(abs(values))) / period

    assert rate(gains) == pytest.approx(by_numpy(gains), rel=1e-12)
    found = jax.grad(rate)(jnp.asarray(gains))
    np.testing.assert_allclose(found, central(by_numpy, gains, 1e-5), rtol=1e-6)


def test_a_jacobian_at_a_known_point_has_derivatives_by_traced_numbers():
    matrix = np.random.default_rng(7).normal(size=(2, 3))

    def jacobian(factor):
        return affine_jacobian(lambda x: factor**2 * (matrix @ x), np.zeros(3))

    np.testing.assert_allclose(jax.jacfwd(jacobian)(3.0), 6.0 * matrix, rtol=1e-12)


@pytest.mark.parametrize("count", [20, 21])  # of times, without and with that of the crossing
def test_branches_that_cross_go_on_straight(count):
    t = np.linspace(-1, 1, count)
    up, down = -1 + 0.5 * t + 3j, -1 - 0.4 * t + 3.005j
    followed = _tracked_branches(np.sort(np.stack([up, down], axis=1), axis=1))
    np.testing.assert_array_equal(followed, np.stack([up, down], axis=1))


@pytest.mark.parametrize("spread", [1.0, 0.01])
def test_branches_have_the_poles_of_the_smallest_sum(spread):
    """Poles that coincide, as those of delays, and poles nearest to two branches at once."""
    rng = np.random.default_rng(3)
    poles = np.append(rng.standard_normal(6), [0.5, 0.5])
    branches = np.append(rng.permutation(poles[:6]) + spread * rng.standard_normal(6), [0.5, 0.5])
    distances = np.abs(branches[:, None] - poles)
    found, expected = _assignment(distances), scipy.optimize.linear_sum_assignment(distances)[1]
    assert sorted(found) == list(range(8))
    rows = np.arange(8)
    assert distances[rows, found].sum() == pytest.approx(distances[rows, expected].sum(), rel=1e-12)


class GrowingGain(AbstractSampledLaw):
    """Feedback whose gain grows in time."""

    def step(self, state, measurement, t):
        return ControlStep(-1e3 * t * measurement.readings, state)


def test_several_times_at_once_are_those_of_each():
    """The gain varies; delays of parts of a period, and an accelerometer under a moving mass."""
    case = shaker_case(jb.Feedback([1.0], period=0.004, delay=0.006), modes=2)
    sensors = [jb.Sensor(0.25, "acceleration", delay=0.001, filter=jb.Filter(cutoff=60.0, order=2))]
    case = dataclasses.replace(case, sensors=tuple(sensors))
    timing, times = loop_timing(case), np.array([0.2, 0.5, 0.9])
    loop = loop_dynamics(case, mesh_layout(case))
    loop = eqx.tree_at(lambda x: x.law, loop, GrowingGain())
    together = affine_linearisations(loop, timing, times)
    for found, t in zip(together, times, strict=True):
        (alone,) = affine_linearisations(loop, timing, [t])
        for part in ("A", "B", "K"):
            expected = getattr(alone, part)
            size = np.abs(expected).max()
            np.testing.assert_allclose(getattr(found, part), expected, atol=1e-12 * size)
    assert not np.allclose(together[0].K, together[2].K, rtol=1e-2)


def test_growth_of_a_sampled_loop_needs_no_finer_steps(monkeypatch):
    case = shaker_case(jb.Feedback([900.0], period=0.004, delay=0.006), modes=3)
    found = growth(jb.replace(case, {"loads.0.speed": 4.0})).factor
    monkeypatch.setattr(stability, "MAX_PHASE_PER_STEP", stability.MAX_PHASE_PER_STEP / 4)
    finer = growth(jb.replace(case, {"loads.0.speed": 4.0})).factor
    np.testing.assert_allclose(found, finer, atol=1e-6 * finer.max())


def test_a_cubic_term_does_not_change_growth_about_rest():
    """The linear loop is multiplied in NumPy, the other differentiated from sample to sample."""
    laws = [jb.Feedback([900.0], 1, more, period=0.004, delay=0.006) for more in (None, [[1e9]])]
    cases = [jb.replace(shaker_case(law), {"loads.0.speed": 4.0}) for law in laws]
    linear, cubic = (growth(case) for case in cases)
    np.testing.assert_array_equal(cubic.times, linear.times)
    np.testing.assert_allclose(cubic.factor, linear.factor, rtol=1e-7)


def test_sampled_poles_match_simulated_decay():
    """The loop has a delay of one and a half periods, a delayed sensor and a digital filter."""
    filter = jb.Filter(cutoff=60.0, order=2)
    case = shaker_case(
        jb.Feedback([200.0], period=0.004, delay=0.006),
        modes=2,
        loads=[jb.MovingForce(force=2.0, speed=3.0)],
    )
    case = jb.Case(
        beam=case.beam,
        actuators=case.actuators,
        sensors=[jb.Sensor(0.25, delay=0.002, filter=filter)],
        loads=case.loads,
        controller=case.controller,
        run=jb.Run(duration=1.0, sample_rate=250.0),
    )
    poles = linearised_loop(case, 0.9).poles()
    record = jb.simulate(case)
    z = np.exp(poles[0] * 0.004)
    assert poles[1] == pytest.approx(poles[0].conj()) and poles[2].real < poles[0].real - 5
    decay = np.asarray(record.deflection)[150:, 0]
    ahead = 2 * z.real * decay[1:-1] - abs(z) ** 2 * decay[:-2]
    np.testing.assert_allclose(ahead, decay[2:], atol=3e-5 * np.abs(decay).max())


GAIN = np.array([[300.0, -800.0, 12.0, 0.5, 0.0]])


def closed_matrix(x, speed, mass):
    """State matrix under state feedback, with the load frozen at x (m)."""
    A, B = state_matrices(x, speed, mass, 4.6, modes=2)
    return A - B @ GAIN


def crossing_transition(speed, end):
    """Transition matrix of the loop over the first part of a crossing."""

    def rate(t, y):
        return (closed_matrix(speed * t, speed, MASS) @ y.reshape(5, 5)).ravel()

    solved = scipy.integrate.solve_ivp(
        rate, (0, end), np.eye(5).ravel(), method="Radau", rtol=1e-9, atol=1e-12
    )
    return solved.y[:, -1].reshape(5, 5)


def test_growth_against_scipy():
    found = growth(shaker_case(jb.StateFeedback(gain=GAIN, coordinates="sine"), modes=2), points=20)
    end = 0.05 * LENGTH / SPEED
    assert found.times[1] == pytest.approx(end, rel=1e-12) and found.factor[0] == 1.0
    n = np.array([1, 2]) * np.pi / LENGTH
    shaker, half = np.sin(n * SHAKER_POSITION), DENSITY * LENGTH / 2
    stiffness = half * np.diag(n**4 * RIGIDITY / DENSITY) + SPRING * np.outer(shaker, shaker)
    root = np.linalg.cholesky(scipy.linalg.block_diag(stiffness, half * np.eye(2))).T
    part = root @ crossing_transition(SPEED, end)[:4, :4] @ np.linalg.inv(root)
    assert found.factor[1] == pytest.approx(np.linalg.norm(part, ord=2), rel=1e-4)


def test_limit_of_a_gain_is_its_gain_margin():
    """The mass of the load is negligible."""
    case = shaker_case(
        jb.Feedback([100.0], period=0.004), modes=2, loads=[jb.MovingMass(mass=1e-9, speed=SPEED)]
    )

    def worst(case):
        return frozen_poles(case, np.array([0.5])).largest_real_part.max()

    found = stability_limit(case, "controller.gains.0", 100.0, 1e5, worst, points=8)
    margin = margins(linearised_loop(case, 0.5))
    assert found == pytest.approx(100.0 * margin.gain, rel=1e-5)
    assert margin.lower_gain == 0.0
    with pytest.raises(ValueError, match="unstable already at controller.gains.0 = 20000"):
        stability_limit(case, "controller.gains.0", 2e4, 1e5, worst)
    assert stability_limit(case, "controller.gains.0", 100.0, 200.0, worst, points=2) is None


def test_margins_against_python_control():
    control = pytest.importorskip("control")
    loop = linearised_loop(shaker_case(jb.Feedback([3000.0]), modes=2), 0.0)
    found = margins(loop)
    system = control.ss(*(np.asarray(part) for part in (loop.A, loop.B, -loop.K)), 0)
    gain, phase, distance, _, crossover, _ = control.stability_margins(system)
    assert found.gain == pytest.approx(gain, rel=1e-6)
    assert found.phase == pytest.approx(np.radians(phase), rel=1e-6)
    assert found.delay == pytest.approx(np.radians(phase) / crossover, rel=1e-6)
    assert found.modulus_margin == pytest.approx(distance, rel=1e-6)
    # Without feedback the margins are infinite.
    open_loop = dataclasses.replace(loop, K=0.0 * loop.K)
    assert margins(open_loop) == (np.inf, 0.0, np.inf, np.inf, 1.0)


def test_errors_are_named():
    case = shaker_case(jb.Feedback([1.0], period=0.01))
    with pytest.raises(ValueError, match="there is no loop: the case has no controller"):
        linearised_loop(shaker_case(None), 0.0)
    with pytest.raises(ValueError, match="spacing must be a whole number of the controller's"):
        stream(case, 0.0155)
    with pytest.raises(ValueError, match="a stream repeats the one load of a case; this has 0"):
        stream(shaker_case(jb.Feedback([1.0]), loads=[]), 1.0)
    with pytest.raises(ValueError, match="there is no crossing: the case has no loads"):
        growth(shaker_case(jb.Feedback([1.0]), loads=[]))
    with pytest.raises(ValueError, match="low and high must be positive and ascend"):
        stability_limit(case, "loads.0.mass", 2.0, 1.0)
    with pytest.raises(ValueError, match="margins need a stable closed loop"):
        margins(linearised_loop(shaker_case(jb.Feedback([-1e6], period=0.01)), 0.0))
    slow = jb.Case(
        beam=case.beam, actuators=case.actuators, controller=case.controller,
        sensors=[jb.Sensor(0.25, sampling_period=0.02)], run=case.run,
    )  # fmt: skip
    with pytest.raises(ValueError, match="sensors.0.sampling_period must be the controller's"):
        linearised_loop(slow, 0.0)
