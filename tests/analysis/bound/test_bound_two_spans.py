"""Bound of two spans with two patches, by a model of sines with a spring for the support."""

import json

import numpy as np
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import bound
from jaxbeam.analysis.bound.input_influence import InputInfluence
from jaxbeam.analysis.bound.linear_program import least_peak
from tests.modules import DATA

KNOWN = json.loads((DATA / "bounds.json").read_text())["two spans, one mass"]
LENGTH, RIGIDITY, DENSITY, RATIO = 1.2, 12.277, 0.7924, 0.03
STARTS, SENSORS, GRAVITY = (0.2575, 0.8575), (0.3, 0.9), 9.81
MOMENT = 8.292438504838157e-4 * 0.39  # N m/V, corrected
NUMBERS = np.arange(1, KNOWN["sines"] + 1) * np.pi / LENGTH
HOLDS, SUBSTEPS = 120, 16


def shapes(x, derivative=0):
    """Mass-normalised sines at x, or their derivatives."""
    size = np.sqrt(2 / (DENSITY * LENGTH))
    return size * NUMBERS**derivative * np.sin(NUMBERS * x + 0.5 * np.pi * derivative)


def state_matrix(t):
    """Matrix of z' = A z, z = (q, q', commands, 1), with the mass at its position of t (s)."""
    n, frequencies = NUMBERS.size, NUMBERS**2 * np.sqrt(RIGIDITY / DENSITY)
    support = KNOWN["support_stiffness_N_per_m"] * np.outer(shapes(0.6), shapes(0.6))
    mass, speed = KNOWN["mass"], KNOWN["speed"]
    under, slope, curvature = (shapes(speed * t, order) for order in range(3))
    force = np.zeros((n, 2 * n + 3))
    force[:, :n] = -np.diag(frequencies**2) - support - mass * speed**2 * np.outer(under, curvature)
    force[:, n : 2 * n] = -np.diag(2 * RATIO * frequencies) - 2 * mass * speed * np.outer(
        under, slope
    )
    for i, start in enumerate(STARTS):
        force[:, 2 * n + i] = MOMENT * (shapes(start, 1) - shapes(start + 0.085, 1))
    force[:, -1] = -mass * GRAVITY * under
    accelerations = np.linalg.solve(np.eye(n) + mass * np.outer(under, under), force)
    rates = np.eye(n, 2 * n + 3, k=n)
    return np.vstack([rates, accelerations, np.zeros((3, 2 * n + 3))])


def hold_transition(k):
    """Transition matrix of (q, q', commands, 1) over hold k: Magnus exponentials of order 4."""
    period, node = KNOWN["period_s"], np.sqrt(3) / 6
    step, transition = period / SUBSTEPS, np.eye(2 * NUMBERS.size + 3)
    for j in range(SUBSTEPS):
        times = (k * period + (j + 0.5 + sign * node) * step for sign in (-1, 1))
        first, second = map(state_matrix, times)
        for a, b in ((0.25 + node, 0.25 - node), (0.25 - node, 0.25 + node)):
            transition = scipy.linalg.expm(step * (a * first + b * second)) @ transition
    return transition


def reference_influence() -> InputInfluence:
    """Influence of the commands by the model of sines, at the ends of the holds."""
    n, size = NUMBERS.size, 2 * NUMBERS.size
    unforced, response = np.zeros((HOLDS + 1, n)), np.zeros((HOLDS + 1, n, HOLDS, 2))
    state, unit_states = np.zeros(size), np.zeros((size, HOLDS, 2))
    for k in range(HOLDS):
        transition = hold_transition(k)
        state = transition[:size, :size] @ state + transition[:size, -1]
        unit_states = np.tensordot(transition[:size, :size], unit_states, axes=1)
        unit_states[:, k] += transition[:size, size : size + 2]
        unforced[k + 1], response[k + 1] = state[:n], unit_states[:n]
    rows, times = np.array([shapes(x) for x in SENSORS]), np.arange(HOLDS + 1) * KNOWN["period_s"]
    return InputInfluence(rows, times[:-1], times, unforced, response)


def test_linear_program_has_the_bound_of_the_reference():
    influence = reference_influence()
    uncontrolled = np.max(np.abs(influence.unforced @ influence.deflection_rows.T))
    assert_allclose(uncontrolled, KNOWN["uncontrolled_m"], rtol=1e-6)
    low, high = np.array([[-2.5, -2.5], [7.5, 7.5]]) * 200
    peak, commands, _ = least_peak(influence, low, high, np.full(2, np.inf))
    # The program of the reference is in metres, with feasibility tolerances of 1e-7.
    assert_allclose(peak, KNOWN["least_peak_m"], rtol=0, atol=1.1e-7)
    assert_allclose(np.max(np.abs(influence.deflection(commands))), peak, rtol=1e-5)


def test_bound_with_exact_modes_is_near_the_reference():
    """Seven exact modes, for eight sines and the spring of the support."""
    patches = [
        jb.Patch(x, x + 0.085, MOMENT, amplifier_gain=200.0, limits=[-2.5, 7.5]) for x in STARTS
    ]
    case = jb.Case(
        jb.Beam(LENGTH, RIGIDITY, DENSITY, RATIO, modes=7),
        [jb.Support(0.6)],
        patches,
        [jb.Sensor(x) for x in SENSORS],
        [jb.MovingMass(mass=KNOWN["mass"], speed=KNOWN["speed"])],
        run=jb.Run(1.2),
    )
    found = bound(case, spacing=KNOWN["checked_every_s"])
    assert_allclose(found.peak, KNOWN["least_peak_m"], rtol=2e-3)
    assert_allclose(found.reduction, 1 - KNOWN["least_peak_m"] / KNOWN["uncontrolled_m"], atol=1e-3)
