"""Stability limits in mass and speed; tracked branches; frozen poles and multipliers."""

import dataclasses
import re

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import jaxbeam as jb
from jaxbeam.analysis.stability import (
    LoadStabilityLimits,
    frozen_poles,
    growth,
    load_stability_limits,
    stream,
    stream_excess,
)
from jaxbeam.cli import main
from tests.analysis import test_stability as oracle
from tests.analysis.test_stability import (
    LENGTH,
    MASS,
    SPEED,
    regulator,
    shaker_case,
    state_matrices,
)

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
