"""Stability limits in mass and speed; tracked branches; frozen poles and multipliers."""

import dataclasses
import re

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.compare import command_oscillations, count_oscillations, turning_points
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.analysis.stability import (
    LoadStabilityLimits,
    frozen_poles,
    growth,
    load_stability_limits,
    margins,
    stability_margin,
    stream,
    stream_excess,
)
from jaxbeam.case.library.rigs import load
from jaxbeam.cli import main
from jaxbeam.simulation.integration_plan import integration_plan
from tests.analysis import test_stability as oracle
from tests.analysis.test_stability import (
    LENGTH,
    MASS,
    SPEED,
    regulator,
    shaker_case,
    state_matrices,
)
from tests.loop_as_oracle import span_of
from tests.oracles.sampled_plant import over_period

STATES = np.diag([1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0])


def regulated(x, speed=SPEED, mass=MASS):
    """State matrix of the published full state feedback, with the load frozen at x (m)."""
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6)
    P = scipy.linalg.solve_continuous_are(A, B, STATES, [[9e-5]])
    return state_matrices(x, speed, mass, 4.6)[0] - B @ B.T @ P / 9e-5


def fastest_growth(speed, mass):
    """Largest real part (1/s) of the poles under regulated state feedback over the crossing."""
    positions = LENGTH * np.linspace(0.0, 1.0, 101)[:-1]
    return max(np.linalg.eigvals(regulated(x, speed, mass)).real.max() for x in positions)


def test_stability_limits_of_published_regulator():
    """The largest real part of the poles over the crossing turns positive at the limit."""
    case = jb.replace(shaker_case(regulator()), {"loads.0.mass": 0.15})
    found = load_stability_limits(case, factor=2.0, points=3)
    mass = scipy.optimize.brentq(lambda m: fastest_growth(SPEED, m), 0.15, 0.3, rtol=1e-7)
    assert found.mass == pytest.approx(mass, rel=1e-5)
    assert found.speed == np.inf and fastest_growth(2 * SPEED, 0.15) < 0


@pytest.mark.parametrize(
    ("limit", "expected"),
    [(0.7, 0.7), (0.2, 0.2), (0.01, 0.0), (1e3, np.inf)],  # above, below, below all values, none
)
def test_limits_above_and_below_the_value(limit, expected):
    case = shaker_case(jb.Feedback([1.0]))
    found = load_stability_limits(case, lambda case: float(case.loads[0].mass) - limit, points=4)
    assert found.mass == pytest.approx(expected, rel=1e-5)
    assert found.speed == (np.inf if limit > MASS else 0.0)


def test_load_without_speed_has_no_speed_limit():
    stationary = [jb.MovingMass(mass=0.1, times=[0.0, 1.0], positions=[0.2, 0.2])]
    case = shaker_case(jb.Feedback([1.0]), loads=stationary)
    assert load_stability_limits(case, lambda case: -1.0, points=2) == LoadStabilityLimits(
        np.inf, None
    )
    left = shaker_case(jb.Feedback([1.0]), loads=[jb.MovingMass(mass=0.1, speed=-1.0)])
    found = load_stability_limits(left, lambda case: -2.0 - float(case.loads[0].speed), points=4)
    assert found == LoadStabilityLimits(np.inf, pytest.approx(2.0, rel=1e-5))
    with pytest.raises(ValueError, match="there is no load whose mass or speed"):
        load_stability_limits(shaker_case(jb.Feedback([1.0]), loads=[]))


def test_branches_are_tracked_where_modes_cross():
    """Two pairs of the published loop swap their frequencies near midspan.

    The reference tracks them by correlation of eigenvectors, in much shorter steps.
    """
    positions = np.linspace(0.2, 0.42, 45)
    found = frozen_poles(shaker_case(regulator()), positions / SPEED)
    fine, vectors = [], None
    for x in np.linspace(0.2, 0.42, 44 * 50 + 1):
        values, columns = np.linalg.eig(regulated(x))
        if vectors is None:
            order = np.argsort(values.imag)
        else:
            correlation = np.abs(vectors.conj().T @ columns)
            order = scipy.optimize.linear_sum_assignment(-correlation)[1]
        vectors = columns[:, order]
        fine.append(values[order])
    fine = np.array(fine)[::50]
    start = np.argsort(found.poles[0].imag)
    np.testing.assert_allclose(found.poles[:, start], fine, rtol=1e-6)
    # Sorting by frequency at each position would exchange them.
    upper = fine[:, -2:].imag
    assert np.all(np.diff(upper[0]) > 0) != np.all(np.diff(upper[-1]) > 0)


def monodromy_matrix(row, speed, mass, spacing, steps=400):
    """Transition matrix of one period of a stream: Magnus exponentials of order 4."""
    end, size = LENGTH / speed, row.shape[1]
    step, transition, node = end / steps, np.eye(size), np.sqrt(3) / 6

    def closed(t):
        A, B = state_matrices(speed * t, speed, mass, 4.6, modes=2)
        return A - B @ row

    for k in range(steps):
        first, second = (closed(step * (k + 0.5 + side * node)) for side in (-1, 1))
        commutator = np.sqrt(3) / 12 * step**2 * (second @ first - first @ second)
        transition = scipy.linalg.expm(step / 2 * (first + second) + commutator) @ transition
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6, modes=2)
    return scipy.linalg.expm((spacing - end) * (A - B @ row)) @ transition


def largest_frozen(row, speed, mass):
    """Largest real part (1/s) of the frozen poles over the crossing, with a feedback row."""
    positions = LENGTH * np.linspace(0.0, 1.0, 101)[:-1]
    frozen = [state_matrices(x, speed, mass, 4.6, modes=2) for x in positions]
    return max(np.linalg.eigvals(A - B @ row).real.max() for A, B in frozen)


def state_feedback_case(row, speed, mass):
    """Case with two modes under state feedback."""
    case = shaker_case(jb.StateFeedback(gain=row, coordinates="sine"), modes=2)
    return jb.replace(case, {"loads.0.speed": speed, "loads.0.mass": mass})


def test_stream_is_stable_with_unstable_frozen_poles():
    """A beam without control dissipates; with a load frozen at 12 m/s it has unstable poles."""
    row, speed, spacing = np.zeros((1, 5)), 12.0, 1.5 * LENGTH / 12.0
    case = state_feedback_case(row, speed, MASS)
    worst, found = frozen_poles(case).largest_real_part.max(), stream(case, spacing)
    assert worst == pytest.approx(largest_frozen(row, speed, MASS), rel=1e-6) and worst > 10
    expected = np.abs(np.linalg.eigvals(monodromy_matrix(row, speed, MASS, spacing))).max()
    assert found.largest_multiplier == pytest.approx(expected, rel=1e-4) and found.stable
    slow = dataclasses.replace(case.loads[0], speed=np.asarray(6.0))
    limits = load_stability_limits(
        dataclasses.replace(case, loads=(slow,)), stream_excess(0.15), 3.0, 3
    )
    assert limits == LoadStabilityLimits(np.inf, np.inf)
    # Frozen poles give a limit.
    limit = scipy.optimize.brentq(lambda v: largest_frozen(row, v, MASS), 6.0, 12.0, rtol=1e-7)
    found = load_stability_limits(dataclasses.replace(case, loads=(slow,)), factor=3.0, points=3)
    assert found.speed == pytest.approx(limit, rel=1e-5)


def test_stream_of_a_sampled_loop():
    """Commands held for a period, by scipy: thirty periods with the load, ten without it."""
    row, speed, period = np.array([[300.0, -800.0, 12.0, 0.5, 0.0]]), 20.0, 1e-3
    case = state_feedback_case(row, speed, MASS)
    law = dataclasses.replace(case.controller, period=np.asarray(period))
    found = stream(dataclasses.replace(case, controller=law), 0.04)

    def matrices_at(t):
        return state_matrices(speed * t, speed, MASS * (t < LENGTH / speed), 4.6, modes=2)

    transition = np.eye(5)
    for start in period * np.arange(40):
        A, B = over_period(matrices_at, start, start + period, [LENGTH / speed])
        transition = (A - B @ row) @ transition
    largest = np.sort(np.abs(np.linalg.eigvals(transition)))[-3:]
    np.testing.assert_allclose(np.sort(np.abs(found.multipliers))[-3:], largest, rtol=2e-4)


@pytest.mark.parametrize("period", [None, 1e-3])
def test_stream_of_loads_closer_than_a_crossing(period):
    """Every 20 ms a mass of 30 ms on the beam, by scipy; given by its speed, or by a table."""
    row, speed = np.array([[300.0, -800.0, 12.0, 0.5, 0.0]]), 20.0
    case = state_feedback_case(row, speed, MASS)
    if period is not None:
        table = jb.MovingMass(mass=MASS, times=[-0.01, 0.04], positions=[-0.2, 0.8])
        law = dataclasses.replace(case.controller, period=np.asarray(period))
        case = dataclasses.replace(case, controller=law, loads=(table,))
    found = stream(case, 0.02)

    def matrices_at(t):
        masses = MASS * np.array([1.0, t < 0.01])
        A, B = state_matrices(speed * np.array([t, t + 0.02]), speed, masses, 4.6, modes=2)
        return (A - B @ row, 0 * B) if period is None else (A, B)

    held, transition = 0.02 if period is None else period, np.eye(5)
    for start in np.arange(0.0, 0.02 - 1e-9, held):
        A, B = over_period(matrices_at, start, start + held, [0.01])
        transition = (A - B @ row) @ transition
    largest = np.sort(np.abs(np.linalg.eigvals(transition)))[-3:]
    np.testing.assert_allclose(np.sort(np.abs(found.multipliers))[-3:], largest, rtol=2e-4)


def test_crossing_amplifies_with_stable_frozen_poles(monkeypatch):
    """Deviations grow more than twentyfold; all frozen poles are left of -2.5 1/s."""
    monkeypatch.setattr(oracle, "DAMPER", 166.8)
    row, speed, mass = np.array([[-1740.0, 7280.0, -45.0, -290.0, 0.0]]), 10.77, 0.125
    case = state_feedback_case(row, speed, mass)
    found, worst = growth(case, 20), frozen_poles(case).largest_real_part.max()
    assert worst == pytest.approx(largest_frozen(row, speed, mass), rel=1e-6) and worst < -2.5
    n, half = np.arange(1, 3) * np.pi / LENGTH, oracle.DENSITY * LENGTH / 2
    shaker = np.sin(n * oracle.SHAKER_POSITION)
    stiffness = half * np.diag(n**4 * oracle.RIGIDITY / oracle.DENSITY)
    stiffness += oracle.SPRING * np.outer(shaker, shaker)
    root = np.linalg.cholesky(scipy.linalg.block_diag(stiffness, half * np.eye(2))).T
    transition = monodromy_matrix(row, speed, mass, LENGTH / speed)[:4, :4]
    expected = np.linalg.norm(root @ transition @ np.linalg.inv(root), 2)
    assert found.factor[-1] == pytest.approx(expected, rel=1e-4) and expected > 20


def test_command_prints_limits_and_multipliers(tmp_path, capsys):
    case = jb.replace(shaker_case(jb.Feedback([3000.0]), modes=2), {"loads.0.speed": 6.0})
    jb.save_case(case, tmp_path / "case.toml")

    with pytest.raises(SystemExit) as ended:
        main(["stability", str(tmp_path / "case.toml"), "--limits", "--headway", "0.15"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert (
        f"multiplied by at most {stream(case, 0.15).largest_multiplier:.4g} each time: stable"
        in text
    )
    mass = float(re.search(r"loads frozen the loop is unstable from (\S+) kg on", text)[1])
    for share, unstable in ((0.999, False), (1.001, True)):
        poles = frozen_poles(jb.replace(case, {"loads.0.mass": share * mass}))
        assert (poles.largest_real_part.max() > 0) == unstable
    assert "with a stream the loop is unstable at no" in text


# Margins of loops with delays of several periods, against independent matrices.

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


# Oscillation of commands in unstable loops; loops that stationary loads make unstable.

TIMES = np.arange(2001) / 1000


def test_turning_points_leave_out_small_reversals():
    small = 0.05 * np.sin(2 * np.pi * 40 * TIMES)
    slow = np.sin(2 * np.pi * 1.0 * TIMES)
    turns = turning_points(slow + small)
    assert_allclose(TIMES[turns], [0.25, 0.75, 1.25, 1.75], atol=0.02)
    assert turning_points(TIMES) == turning_points(0 * TIMES) == []
    assert turning_points(np.where(TIMES > 1, np.nan, slow)) == []


def test_oscillations_are_counted_beyond_those_of_the_deflection():
    growing, zero = np.exp(TIMES) * np.sin(2 * np.pi * 9.0 * TIMES), np.zeros(TIMES.size)
    unlimited = count_oscillations(TIMES, growing, zero > 0, zero)
    assert unlimited.oscillates and not unlimited.limit_cycle
    assert_allclose(unlimited.frequency, 9.0, rtol=0.02)
    limited = count_oscillations(TIMES, np.clip(growing, -2, 2), np.abs(growing) >= 2, zero)
    assert limited.limit_cycle and limited.at_limits > 10
    forced = count_oscillations(TIMES, -growing, zero > 0, growing)
    assert forced.extra == 0 and not forced.oscillates


def test_a_command_is_compared_with_its_own_or_the_last_sensor():
    """Of three commands, all with the reversals of the second of two sensors."""
    case = jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=2),
        actuators=[jb.PointForce(x) for x in (0.1, 0.2, 0.3)],
        sensors=[jb.Sensor(0.2), jb.Sensor(0.3)],
        loads=[jb.MovingForce(force=1.0, speed=0.4)],
        controller=jb.OutputFeedback(np.zeros((3, 2))),
        run=jb.Run(2.0),
    )
    record = jb.simulate(case)
    slow, fast = (np.sin(2 * np.pi * f * TIMES) for f in (1.0, 9.0))
    shapes = np.asarray(record.modes.shapes(np.array([0.2, 0.3])))
    coordinates = np.linalg.solve(shapes, np.stack([slow, fast])).T
    uncontrolled = dataclasses.replace(record, coordinates=coordinates)
    controlled = dataclasses.replace(record, command=np.stack([fast] * 3, axis=1))
    found = command_oscillations(controlled, uncontrolled)
    assert [one.extra for one in found] == [2 * 2 * (9 - 1), 0, 0]


def unstable_case(gain: float, delay: float | None, damping: float) -> jb.Case:
    """Two spans under the cubic law, through filters of 20 Hz, as in section 6.2."""
    case = load("C")
    filtered = jb.Filter(20.0, order=10, realisation="analogue")
    sensors = tuple(dataclasses.replace(sensor, filter=filtered) for sensor in case.sensors)
    law = jb.Feedback([gain * 1e9] * 2, power=3, period=0.002, delay=delay)
    case = dataclasses.replace(case, sensors=sensors, controller=law)
    return jb.replace(case, {"beam.damping_ratio": damping})


def test_growth_rate_with_stationary_load_against_reference():
    """Rightmost pole of 0.509 kg at midspan, linear law with k = 2, filter of 10 Hz, 5 modes."""
    case = jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=5),
        actuators=[jb.Patch(0.2575, 0.3425, 2.65358032154821e-4, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.3, filter=jb.Filter(10.0, 10, realisation="analogue"))],
        loads=[jb.MovingMass(mass=0.509, speed=0.5)],
        controller=jb.Feedback([2e3]),
        run=jb.Run(1.2),
    )
    unstable = stability_margin(case).unstable
    assert unstable is not None and unstable.start < 0.6 < unstable.end
    assert_allclose(unstable.rate, 0.6891684603605122, rtol=1e-6)
    assert_allclose(2 * np.pi * unstable.frequency, 62.83126204745206, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_high_gain_has_published_limit_cycle():
    """k = 3, 30 ms of delay and low damping: unstable from 0.322 kg, not at 0.261 kg.

    With 0.261 kg the commands oscillate within the limits.
    """
    case = unstable_case(3.0, 0.03, 0.01)
    uncontrolled = dataclasses.replace(case, controller=None)
    plan, uncontrolled_plan = (
        integration_plan(case, None, 1e-4),
        integration_plan(uncontrolled, None, 1e-4),
    )
    for mass, limit_cycle in ((0.261, False), (0.322, True), (0.509, True)):
        change = {"loads.0.mass": mass}
        oscillations = command_oscillations(
            jb.simulate(jb.replace(case, change), plan=plan),
            jb.simulate(jb.replace(uncontrolled, change), plan=uncontrolled_plan),
        )
        assert [one.limit_cycle for one in oscillations] == [limit_cycle, limit_cycle]
    unstable = stability_margin(jb.replace(case, {"loads.0.mass": 0.322})).unstable
    assert unstable is not None and unstable.rate > 1
    assert_allclose(oscillations[0].frequency, unstable.frequency, rtol=0.25)
