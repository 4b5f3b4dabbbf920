"""Riccati equations: against scipy, python-control and a stiff integration of (3.8)."""

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.control.lqr import LQR
from jaxbeam.numerics.riccati import care, dare, dlqr, lqr, lyapunov, stein
from tests.differences import central

R = jnp.array([[0.1, 0.02], [0.02, 0.3]])


def plant(seed=0, states=6):
    """A, B, Q and N of a random unstable plant with a fast lag."""
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(states, states)), random.normal(size=(states, 2))
    A[-1, -1] = -1e4
    half = random.normal(size=(states, states))
    N = 0.05 * random.normal(size=(states, 2))
    return [jnp.asarray(part) for part in (A, B, np.eye(states) + half @ half.T, N)]


def assert_close(found, expected, tolerance):
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_algebraic_equations_against_scipy(seed):
    A, B, Q, N = plant(seed)
    assert_close(care(A, B, Q, R), scipy.linalg.solve_continuous_are(A, B, Q, R), 1e-11)
    assert_close(care(A, B, Q, R, N), scipy.linalg.solve_continuous_are(A, B, Q, R, s=N), 1e-11)
    A = A.at[-1, -1].set(0.3)
    assert_close(dare(A, B, Q, R), scipy.linalg.solve_discrete_are(A, B, Q, R), 1e-11)
    assert_close(dare(A, B, Q, R, N), scipy.linalg.solve_discrete_are(A, B, Q, R, s=N), 1e-11)


def test_gains_against_python_control():
    A, B, Q, N = plant()
    gain, cost, _ = control.lqr(*map(np.asarray, (A, B, Q, R, N)))
    found = lqr(A, B, Q, R, N)
    assert_close(found[0], gain, 1e-10)
    assert_close(found[1], cost, 1e-10)
    A = A.at[-1, -1].set(0.3)
    gain, _, _ = control.dlqr(*map(np.asarray, (A, B, Q, R, N)))
    assert_close(dlqr(A, B, Q, R, N)[0], gain, 1e-10)


def test_lyapunov_and_stein_equations():
    A, _, Q, _ = plant()
    A = A - 5 * jnp.eye(6)
    assert_close(lyapunov(A, Q), scipy.linalg.solve_continuous_lyapunov(A.T, -Q), 1e-12)
    A = A.at[-1, -1].set(0.3) / 12
    assert_close(stein(A, Q), scipy.linalg.solve_discrete_lyapunov(A.T, Q), 1e-12)


@pytest.mark.parametrize("solve", [lqr, dlqr])
def test_derivatives_forward_and_in_reverse(solve):
    A, B, _, N = plant(3, 4)
    A = A.at[-1, -1].set(-40.0 if solve is lqr else 0.3)

    def gain(numbers):
        weights = jnp.diag(jnp.exp(numbers[:4]))
        return solve(A * numbers[4], B, weights, R * numbers[5], N * numbers[4])[0]

    point = jnp.array([0.1, -0.3, 0.2, 1.0, 1.0, 1.0])
    forward = jax.jit(jax.jacfwd(gain))(point)
    assert_close(forward, central(jax.jit(gain), point, 1e-3), 1e-8)
    assert_close(jax.jit(jax.jacrev(gain))(point), forward, 1e-10)


def test_batch_of_weights():
    A, B, Q, _ = plant()
    factors = jnp.array([0.5, 1.0, 100.0])
    found = jax.jit(jax.vmap(lambda factor: care(A, B, factor * Q, R)))(factors)
    for factor, each in zip(factors, found, strict=True):
        assert_close(each, scipy.linalg.solve_continuous_are(A, B, factor * Q, R), 1e-11)


def test_equations_without_a_solution_are_refused():
    A, B, Q, _ = plant()
    with pytest.raises(ValueError, match="R must be positive definite"):
        care(A, B, Q, -R)
    with pytest.raises(ValueError, match="Q must be positive semidefinite"):
        care(A, B, Q.at[0, 0].set(-9.0), R)
    with pytest.raises(ValueError, match="Q must be symmetric"):
        dare(A, B, Q.at[0, 1].set(9.0), R)
    with pytest.raises(ValueError, match="no stabilising solution"):
        care(jnp.eye(6), 0 * B, Q, R)
    assert jnp.isnan(jax.jit(care)(jnp.eye(6), 0 * B, Q, R)).all()


# Optimal gains over whole crossings, against a stiff integration of the Riccati equation.

SHARES = np.array([0.0, 0.123, 0.25, 0.377, 0.5, 0.61, 0.75, 0.9, 0.97, 0.9999])


def one_span():
    """One span with a shaker, whose lag of 0.1 ms makes the equation stiff."""
    shaker = jb.Shaker(0.5, 12000.0, 80.0, force_per_volt=4.6, bandwidth=1e4)
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[shaker],
        loads=[jb.MovingMass(mass=0.509, speed=1.0)],
    )
    return case, LQR(
        [1000.0, 100.0, 0.1, 0.01, 0.0], [9e-5], coordinates="sine", horizon="crossing"
    )


def two_spans():
    """Two spans with a patch on each."""
    patches = [
        jb.Patch(x, x + 0.085, 8.292e-4, correction=0.39, amplifier_gain=200.0)
        for x in (0.2575, 0.8575)
    ]
    case = jb.Case(
        jb.Beam(1.2, 12.277, 0.7924, 0.03, modes=2),
        [jb.Support(0.6)],
        patches,
        loads=[jb.MovingMass(mass=0.509, speed=2.0)],
    )
    return case, LQR(
        [1e6] * 2 + [10.0] * 2, [1e-3, 1e-3], terminal_weight=[1e4] * 4, horizon="crossing"
    )


@pytest.mark.parametrize("rig", [one_span, two_spans])
def test_gains_are_accurate_to_1e_8(rig):
    """dP/dt = -P A - A'P - Q + P B R^-1 B'P backward in time, by scipy's Radau at 1e-10."""
    case, regulator = rig()
    model, end = jb.state_space(case, regulator.coordinates), 0.6
    table = eqx.filter_jit(lambda m: regulator.gain_table(m))(model)
    found = np.asarray(jax.jit(jax.vmap(table))(jnp.asarray(SHARES)))
    Q, R = map(np.asarray, regulator.weights(model))
    terminal = Q if regulator.terminal_weight is None else np.diag(regulator.terminal_weight)
    upper = np.triu_indices(Q.shape[0])
    system_matrices = jax.jit(lambda t: (model.A(t), model.B(t)))

    def matrices(time_to_go, packed):
        """A, B, P and the gain at a time `time_to_go` (s) before the end."""
        A, B = map(np.asarray, system_matrices(np.clip(end - time_to_go, 0.0, end * (1 - 1e-15))))
        P = np.zeros_like(Q)
        P[upper] = packed
        P = P + np.triu(P, 1).T
        return A, B, P, np.linalg.solve(R, B.T @ P)

    def rate(time_to_go, packed):
        A, B, P, gain = matrices(time_to_go, packed)
        return (P @ A + A.T @ P + Q - P @ B @ gain)[upper]

    def jacobian(time_to_go, packed):
        A, B, P, gain = matrices(time_to_go, packed)
        closed, columns = A - B @ gain, []
        for i, j in zip(*upper, strict=True):
            change = np.zeros_like(P)
            change[i, j] = change[j, i] = 1.0
            columns.append((change @ closed + closed.T @ change)[upper])
        return np.array(columns).T

    times_to_go = end * (1 - SHARES[::-1])
    size = np.max(np.abs(terminal)) + np.max(np.abs(Q)) * end
    solution = solve_ivp(
        rate,
        (0.0, end),
        terminal[upper],
        "Radau",
        times_to_go,
        rtol=1e-10,
        atol=1e-16 * size,
        jac=jacobian,
    )
    expected = [matrices(s, y)[3] for s, y in zip(times_to_go, solution.y.T, strict=True)][::-1]
    errors = [
        np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in zip(found, expected, strict=True)
    ]
    assert np.max(errors) < 1e-8


RIGIDITY, DENSITY, SPEED, MASS, COMMAND_WEIGHT = 13.211, 0.812, 2.0, 0.4, 1e-3
WAVES = np.arange(1, 8) * np.pi / 0.6
FASTEST = WAVES[-1] ** 2 * np.sqrt(RIGIDITY / DENSITY)
WEIGHTS = [1e6] * 7 + [10.0] * 7
# Dense towards the end, where gains oscillate and change fast.
BEFORE_END = np.geomspace(0.3, 1e-6, 1500)
FINE_SHARES = np.sort(np.concatenate([np.linspace(0.0, 0.999, 1500), 1 - BEFORE_END]))


@pytest.fixture(scope="module")
def seven_modes():
    """Gains of a point force on pinned ends over a crossing, by scipy's DOP853 at 1e-10.

    The equations of motion are written out: (1 + m s s') q'' + ... for a row s of mode shapes.
    """
    norm, upper, end = np.sqrt(2 / (DENSITY * 0.6)), np.triu_indices(14), 0.6 / SPEED
    modal_forces, squares = norm * np.sin(0.25 * WAVES), WAVES**4 * RIGIDITY / DENSITY

    def plant(t):
        s, slope = norm * np.sin(SPEED * t * WAVES), norm * WAVES * np.cos(SPEED * t * WAVES)
        stiffness = np.diag(squares) - MASS * SPEED**2 * np.outer(s, WAVES**2 * s)
        damping = np.diag(0.06 * np.sqrt(squares)) + 2 * MASS * SPEED * np.outer(s, slope)
        share = MASS * s / (1 + MASS * s @ s)
        free_rows = -np.hstack([stiffness, damping])
        A = np.vstack(
            [np.hstack([np.zeros((7, 7)), np.eye(7)]), free_rows - np.outer(share, s @ free_rows)]
        )
        return A, np.append(np.zeros(7), modal_forces - share * (s @ modal_forces))

    def matrices(time_to_go, packed):
        A, B = plant(end - time_to_go)
        P = np.zeros((14, 14))
        P[upper] = packed
        P.T[upper] = packed
        return A, P, P @ B

    def rate(time_to_go, packed):
        A, P, PB = matrices(time_to_go, packed)
        half = P @ A
        return (half + half.T + np.diag(WEIGHTS) - np.outer(PB, PB) / COMMAND_WEIGHT)[upper]

    times_to_go, first = end * (1 - FINE_SHARES[::-1]), np.diag(WEIGHTS)[upper]
    options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10}
    solution = solve_ivp(rate, (0.0, end), first, t_eval=times_to_go, **options)
    gains = [
        matrices(s, y)[2] / COMMAND_WEIGHT for s, y in zip(times_to_go, solution.y.T, strict=True)
    ]
    return np.array(gains)[::-1]


@pytest.mark.parametrize(("phase_step", "error"), [(3.0, 3e-4), (1.0, 2e-6), (0.5, 1e-7)])
def test_gains_are_accurate_between_breakpoints_too(seven_modes, phase_step, error):
    """Compared with the largest gain within a hundredth of the crossing."""
    points = int(np.ceil(FASTEST * 0.6 / SPEED / phase_step))
    case = jb.Case(
        jb.Beam(0.6, RIGIDITY, DENSITY, 0.03, modes=7),
        actuators=[jb.PointForce(0.25)],
        loads=[jb.MovingMass(mass=MASS, speed=SPEED)],
        controller=LQR(WEIGHTS, [COMMAND_WEIGHT], points=points, horizon="crossing"),
    )
    found = jax.jit(
        lambda: jax.vmap(case.controller.gain_table(jb.state_space(case)))(FINE_SHARES)
    )()
    sizes = np.max(np.abs(seven_modes), axis=1)
    local_sizes = [np.max(sizes[np.abs(FINE_SHARES - share) < 0.01]) for share in FINE_SHARES]
    assert np.max(np.max(np.abs(found[:, 0] - seven_modes), axis=1) / local_sizes) < error


def test_batched_designs_call_no_lapack():
    """LAPACK calls of batches on two threads deadlock."""
    case, regulator = two_spans()
    model = jb.state_space(case)

    def gains(command_weight):
        return (
            eqx.tree_at(lambda r: r.command_weight, regulator, command_weight)
            .gain_table(model)
            .coefficients
        )

    program = jax.jit(jax.vmap(gains)).lower(jnp.ones((4, 2))).as_text()
    assert "custom_call" not in program
