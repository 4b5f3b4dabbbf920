"""The bound under several loads, with several kinds of actuators, over the whole beam."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import InputInfluence, bound, least_peak
from tests.modules import DATA

PERIOD = 0.01
BEAM_POSITIONS = np.linspace(0.05, 1.15, 23)
# Two patches, each with a sensor above it, and a shaker with a suspension under the second span.
PATCHES = [
    jb.Patch(x, x + 0.085, 8.292e-4, correction=0.39, amplifier_gain=200.0, limits=[-2.5, 7.5])
    for x in (0.2575, 0.8575)
]
SHAKER = jb.Shaker(1.0, 500.0, 5.0, force_per_volt=4.6, bandwidth=500.0, limits=[-0.5, 0.5])
CASE = jb.Case(
    jb.Beam(1.2, 12.277, 0.7924, 0.03, modes=4),
    [jb.Support(0.6)],
    [*PATCHES, SHAKER],
    [jb.Sensor(0.3), jb.Sensor(0.9), jb.Sensor(1.0)],
    [jb.MovingMass(mass=0.4, speed=2.0), jb.MovingMass(mass=0.2, speed=2.0, entry_time=0.2)],
    jb.StateFeedback(np.ones((3, 9)), period=PERIOD),
    jb.Run(0.6, sample_rate=500.0),
)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_commands_attain_the_bound_on_the_whole_beam():
    """To 1e-3: the change of the deflection between the times of the bound."""
    least = bound(CASE, BEAM_POSITIONS)
    record = jb.simulate(dataclasses.replace(CASE, controller=least.controller()), tolerance=1e-8)
    assert np.max(np.abs(record.at(BEAM_POSITIONS))) < least.peak * (1 + 1e-3)
    assert least.peak < least.uncontrolled


# Bound of two spans with two patches, by a model of sines with a spring for the support.

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
    no_velocities = np.zeros((HOLDS, 0)), np.zeros((HOLDS, 0, HOLDS, 2))
    return InputInfluence(rows, times[:-1], times, unforced, response, *no_velocities)


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


# The least peak under vehicles and varying forces: without commands that of the simulation.

BEAM = jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0, damping_ratio=0.01, modes=3)
LOADS = {
    "vehicle": jb.Oscillator(mass=0.2, stiffness=4e2, damping=2.0, wheel_mass=0.1, speed=2.0),
    "varying force": jb.VaryingForce(force=3.0, frequencies=[2.0], amplitudes=[0.5], speed=2.0),
}


def case_of(load, **parts) -> jb.Case:
    return jb.Case(
        BEAM,
        loads=[load],
        sensors=[jb.Sensor(1.0)],
        actuators=[jb.PointForce(1.0, limits=[-0.5, 0.5])],
        run=jb.Run(1.5, 200.0),
        **parts,
    )


@pytest.mark.parametrize("name", LOADS)
def test_both_peaks_are_those_of_the_simulation(name):
    case = case_of(LOADS[name])
    found = jb.bound(case, period=0.05, spacing=0.005)
    assert_allclose(found.uncontrolled, jb.simulate(case).peak_deflection[0], rtol=1e-6)
    assert 0.0 < found.peak < 0.9 * found.uncontrolled
    controlled = jb.simulate(dataclasses.replace(case, controller=found.controller()))
    assert_allclose(controlled.peak_deflection[0], found.peak, rtol=2e-3)


def test_its_commands_attain_it_on_a_rough_surface():
    case = case_of(LOADS["vehicle"], profile=jb.profiles.SineProfile(2e-3, 0.5))
    found = jb.bound(case, period=0.05, spacing=0.005)
    level = jb.bound(dataclasses.replace(case, profile=None), period=0.05, spacing=0.005)
    assert abs(found.peak - level.peak) > 1e-3 * level.peak
    assert_allclose(found.uncontrolled, jb.simulate(case).peak_deflection[0], rtol=1e-6)
    controlled = jb.simulate(dataclasses.replace(case, controller=found.controller()))
    assert_allclose(controlled.peak_deflection[0], found.peak, rtol=2e-3)
    assert controlled.peak_deflection[0] > found.peak * (1 - 1e-5)
