"""Optimal gains over whole crossings, against a stiff integration of the Riccati equation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.control import FiniteLQR

SHARES = np.array([0.0, 0.123, 0.25, 0.377, 0.5, 0.61, 0.75, 0.9, 0.97, 0.9999])


def one_span():
    """The rig with a shaker, whose lag of 0.1 ms makes the equation stiff."""
    shaker = jb.Shaker(0.5, 12000.0, 80.0, force_per_volt=4.6, bandwidth=1e4)
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[shaker],
        loads=[jb.MovingMass(mass=0.509, speed=1.0)],
    )
    return case, FiniteLQR([1000.0, 100.0, 0.1, 0.01, 0.0], [9e-5], coordinates="sine")


def two_spans():
    """The rig with a patch on each span."""
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
    return case, FiniteLQR([1e6] * 2 + [10.0] * 2, [1e-3, 1e-3], terminal_weight=[1e4] * 4)


@pytest.mark.slow
@pytest.mark.parametrize("rig", [one_span, two_spans])
def test_gains_are_right_to_1e_8(rig):
    """dP/dt = -P A - A'P - Q + P B R^-1 B'P backward in time, by scipy's Radau at 1e-10."""
    case, regulator = rig()
    model, end = jb.state_space(case, regulator.coordinates), 0.6
    table = eqx.filter_jit(lambda m: regulator.gains(m))(model)
    found = np.asarray(jax.jit(jax.vmap(table))(jnp.asarray(SHARES)))
    Q, R = map(np.asarray, regulator.weights(model))
    terminal = Q if regulator.terminal_weight is None else np.diag(regulator.terminal_weight)
    upper = np.triu_indices(Q.shape[0])
    frozen = jax.jit(lambda t: (model.A(t), model.B(t)))

    def parts(since, packed):
        """Plant, P and what the gain sees, so long (s) before the end."""
        A, B = map(np.asarray, frozen(np.clip(end - since, 0.0, end * (1 - 1e-15))))
        P = np.zeros_like(Q)
        P[upper] = packed
        P = P + np.triu(P, 1).T
        return A, B, P, np.linalg.solve(R, B.T @ P)

    def rate(since, packed):
        A, B, P, gain = parts(since, packed)
        return (P @ A + A.T @ P + Q - P @ B @ gain)[upper]

    def slopes(since, packed):
        A, B, P, gain = parts(since, packed)
        closed, columns = A - B @ gain, []
        for i, j in zip(*upper, strict=True):
            change = np.zeros_like(P)
            change[i, j] = change[j, i] = 1.0
            columns.append((change @ closed + closed.T @ change)[upper])
        return np.array(columns).T

    asked = end * (1 - SHARES[::-1])
    size = np.max(np.abs(terminal)) + np.max(np.abs(Q)) * end
    solution = solve_ivp(
        rate, (0.0, end), terminal[upper], "Radau", asked, rtol=1e-10, atol=1e-16 * size, jac=slopes
    )
    expected = [parts(s, y)[3] for s, y in zip(asked, solution.y.T, strict=True)][::-1]
    far = [np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in zip(found, expected, strict=True)]
    assert np.max(far) < 1e-8
