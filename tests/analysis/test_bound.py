"""Least achievable peak: certificate, another solver, kinds of loads and actuators, dampers.

Least integral of the squared deflection against scipy, runs, and other laws.
"""

import dataclasses
import itertools
import json

import clarabel
import jax
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.optimize import OptimizeResult, linprog, lsq_linear

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import InputInfluence, bound, input_influence, least_peak
from jaxbeam.analysis.bound.dampers import damper_peak
from jaxbeam.analysis.bound.least_integral import least_integral
from jaxbeam.analysis.compare import compare
from tests.modules import DATA

BOUNDS = json.loads((DATA / "bounds.json").read_text())
PATCH = jb.Patch(
    0.2575,
    0.3425,
    moment_per_volt=BOUNDS["one span, one mass"]["moment_per_volt"],
    amplifier_gain=200.0,
    limits=[-2.5, 7.5],
)


def patched(modes=5, mass=0.509, speed=1.0, duration=0.6, controller=None) -> jb.Case:
    """One-span laboratory beam with a patch."""
    beam = jb.Beam(0.6, 13.211, 0.812, damping_ratio=0.03, modes=modes)
    load = jb.MovingMass(mass=mass, speed=speed)
    return jb.Case(beam, (), [PATCH], [jb.Sensor(0.3)], [load], controller, jb.Run(duration))


def shaken(volts: float, damping=0.0) -> jb.Case:
    """One-span laboratory beam with a shaker."""
    beam = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3)
    shaker = jb.Shaker(
        0.5, 3500.0, damping, force_per_volt=4.6, bandwidth=1e4, limits=[-volts, volts]
    )
    sensors = [jb.Sensor(x) for x in (0.15, 0.25, 0.35)]
    load = jb.MovingMass(mass=0.509, speed=0.55)
    return jb.Case(beam, (), [shaker], sensors, [load], run=jb.Run(0.6 / 0.55))


@pytest.fixture(scope="module")
def patch_bound():
    return bound(patched())


@pytest.fixture(scope="module")
def influence():
    """Influence of the commands at the sensor."""
    return input_influence(patched(), np.array([0.3]), 0.01, 0.001)


@pytest.fixture(scope="module")
def sensor_influence(influence):
    """Unforced deflection (time,) and responses (time, hold) at the sensor."""
    response = np.einsum("m,tmk->tk", influence.deflection_rows[0], influence.response[..., 0])
    return influence.unforced @ influence.deflection_rows[0], response


@pytest.mark.parametrize(
    ("name", "modes"), [("one span, one mass", 5), ("one span, one mass, eight modes", 8)]
)
def test_reference_numbers(name, modes):
    expected, case = BOUNDS[name], patched(modes)
    influence = input_influence(case, np.array([0.3]), 0.01, 0.01)
    uncontrolled = np.max(np.abs(influence.deflection(np.zeros((60, 1)))))
    assert_allclose(uncontrolled, expected["uncontrolled_m"], rtol=2e-9)
    # The programs of the reference are in metres, with feasibility tolerances of 1e-7.
    assert_allclose(bound(case, spacing=0.01).peak, expected["least_peak_m"], rtol=0, atol=1.1e-7)


@pytest.mark.parametrize("row", BOUNDS["attainable_reduction_percent"])
def test_published_reductions(row):
    if row["rig"] == "patch":
        case = patched(8, row["mass"], row["speed"], 0.6 / row["speed"])
    else:
        case = shaken(row["volts"], row["damping"])
    # Voltages are given to three digits, percentages to one place.
    assert_allclose(100 * bound(case).reduction, row["percent"], atol=0.25)


def test_multipliers_prove_the_bound(patch_bound, sensor_influence):
    """Weak duality: the weighted sum is at least the bound for all commands within the limits."""
    unforced, response = sensor_influence
    weights = np.zeros(unforced.size)
    indices = np.searchsorted(np.arange(601) / 1000, patch_bound.active_constraints.times - 1e-9)
    np.add.at(weights, indices, patch_bound.active_constraints.weights)
    assert np.sum(np.abs(weights)) <= 1 + 1e-9
    slopes = weights @ response
    least = weights @ unforced + np.sum(np.minimum(-2.5 * slopes, 7.5 * slopes))
    assert_allclose(least, patch_bound.peak, rtol=1e-8)
    # The commands attain the bound to 1e-5.
    deflection = unforced + response @ patch_bound.commands[:, 0]
    assert patch_bound.peak <= np.max(np.abs(deflection)) < patch_bound.peak * (1 + 1e-5)
    assert np.min(patch_bound.commands) >= -2.5 and np.max(patch_bound.commands) <= 7.5


def test_another_solver_agrees(patch_bound, sensor_influence):
    unforced, response = sensor_influence
    count = response.shape[1]
    ones, scale = np.ones((unforced.size, 1)), 1e3  # mm
    rows = np.block([[scale * response, -ones], [-scale * response, -ones]])
    box = np.block([[np.eye(count), np.zeros((count, 1))], [-np.eye(count), np.zeros((count, 1))]])
    right_side = np.concatenate(
        [-scale * unforced, scale * unforced, np.full(count, 7.5), np.full(count, 2.5)]
    )
    options = clarabel.DefaultSettings()
    options.verbose = False
    solver = clarabel.DefaultSolver(
        sp.csc_matrix((count + 1, count + 1)),
        np.append(np.zeros(count), 1.0),
        sp.csc_matrix(np.concatenate([rows, box])),
        right_side,
        [clarabel.NonnegativeConeT(right_side.size)],
        options,
    )
    assert_allclose(patch_bound.peak, solver.solve().x[-1] / scale, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_run_attains_the_bound(patch_bound):
    case = dataclasses.replace(patched(), controller=patch_bound.controller())
    record = jb.simulate(case, tolerance=1e-9)
    sampled = np.max(np.abs(record.deflection))
    assert_allclose(sampled, patch_bound.peak, rtol=1e-5)
    # Between the times, a millisecond apart, it is slightly larger.
    assert_allclose(record.peak_deflection[0], patch_bound.peak, rtol=1e-3)
    assert patch_bound.peak < record.peak_deflection[0]
    assert_allclose(patch_bound.share(record), 1.0, atol=4e-3)
    expected = np.repeat(patch_bound.commands[:, 0], 10)
    rounding = 1e-12 * np.max(np.abs(expected))
    assert_allclose(record.command[:-1, 0], expected, rtol=1e-12, atol=rounding)


def test_shares_of_attainable_reduction(patch_bound):
    uncontrolled = jb.simulate(patched(), tolerance=1e-9)
    assert_allclose(patch_bound.uncontrolled, uncontrolled.peak_deflection[0], rtol=1e-8)
    assert_allclose(patch_bound.share(uncontrolled), 0.0, atol=1e-7)
    assert_allclose(patch_bound.reduction, 1 - patch_bound.peak / patch_bound.uncontrolled)
    nearby = dataclasses.replace(patch_bound, positions=np.array([0.3, 0.31]))
    middle = np.max(np.abs(uncontrolled.at(np.array([0.3, 0.31]))))
    expected = (patch_bound.uncontrolled - middle) / (patch_bound.uncontrolled - patch_bound.peak)
    assert_allclose(nearby.share(uncontrolled), expected, rtol=1e-12)


def test_more_positions_raise_the_bound(patch_bound):
    whole_beam = bound(patched(), positions=np.linspace(0.0, 0.6, 61))
    assert patch_bound.peak < whole_beam.peak < patch_bound.uncontrolled
    assert whole_beam.uncontrolled >= patch_bound.uncontrolled * (1 - 1e-9)


def test_slower_actuators_raise_the_bound(patch_bound, influence):
    low, high, change = np.array([[-2.5], [7.5], [0.1]])
    peak, commands, _ = least_peak(influence, low, high, change)
    assert patch_bound.peak * 1.001 < peak < patch_bound.uncontrolled
    assert np.max(np.abs(np.diff(commands[:, 0], prepend=0.0))) <= 0.1 * (1 + 1e-9)
    with pytest.raises(ValueError, match="no commands, starting from zero, meet limits"):
        least_peak(influence, low + 3.0, high, change)


def test_solver_that_fails_is_replaced(patch_bound, influence, monkeypatch):
    """The simplex method fails on about one program in some hundred."""

    def failing_simplex(*program, method, **options):
        if method == "highs":
            return OptimizeResult(status=4, message="(HiGHS Status 0: Not Set)")
        return linprog(*program, method=method, **options)

    monkeypatch.setattr("scipy.optimize.linprog", failing_simplex)
    peak, *_ = least_peak(influence, *np.array([[-2.5], [7.5], [np.inf]]))
    assert_allclose(peak, patch_bound.peak, rtol=1e-6)


def test_without_limits_one_position_is_held_at_zero_once_a_hold(influence):
    parts = {name: getattr(influence, name)[::10] for name in ("times", "unforced", "response")}
    unlimited = np.array([np.inf])
    at_hold_ends = dataclasses.replace(influence, **parts)
    peak, commands, _ = least_peak(at_hold_ends, -unlimited, unlimited, unlimited)
    assert peak < 1e-6 * np.max(np.abs(influence.unforced @ influence.deflection_rows.T))
    assert np.max(np.abs(at_hold_ends.deflection(commands))) < 1e-4 * np.max(
        np.abs(influence.unforced)
    )


def test_two_actuators_and_a_shorter_last_hold():
    """The last hold ends with the run; every actuator has its own commands."""
    force = jb.PointForce(0.2, [0.0, 1.0])
    case = dataclasses.replace(patched(duration=0.333), actuators=(PATCH, force))
    both = bound(case)
    assert both.commands.shape == (34, 2)
    # Limits near zero leave the patch alone, with the compiled programs of both.
    patch_only = bound(jb.replace(case, {"actuators.1.limits.1": 1e-9}))
    assert both.peak < patch_only.peak * (1 - 1e-6)
    assert np.all((both.commands[:, 1] >= 0) & (both.commands[:, 1] <= 1))


ERRORS = {
    "a bound needs actuators": lambda: bound(dataclasses.replace(patched(), actuators=())),
    "none of the 1 takes commands": lambda: bound(
        dataclasses.replace(patched(), actuators=(jb.SpringDamper(0.2, 100.0),))
    ),
    "a bound needs loads": lambda: bound(dataclasses.replace(patched(), loads=())),
    "add a sensor, or give positions": lambda: bound(dataclasses.replace(patched(), sensors=())),
    "positions.1 must lie on the beam": lambda: bound(patched(), positions=[0.1, 0.7]),
    "must be positive": lambda: bound(patched(), period=-0.01),
    "longer than the run": lambda: bound(patched(), period=1.0),
    "half of the .* that are free": lambda: bound(patched(), period=1e-5, spacing=1e-6),
    "neither differentiated nor compiled": lambda: jax.grad(
        lambda mass: bound(jb.replace(patched(), {"loads.0.mass": mass})).peak
    )(0.5),
}


@pytest.mark.parametrize("words", ERRORS)
def test_errors_are_named(words):
    with pytest.raises(ValueError, match=words):
        ERRORS[words]()


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

KNOWN = BOUNDS["two spans, one mass"]
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


L, EI, MASS, DAMPING, FORCE, SPEED = 20.0, 6e9, 9e3, 0.01, 3e5, 40.0
DAMPER, SENSOR, LEAST, MOST = 8.0, 11.0, 2e4, 9e5  # m, N s/m
DAMPER_PERIOD, DAMPER_HOLDS, PARTS = 0.1, 6, 20
DAMPED = jb.Case(
    jb.Beam(L, EI, MASS, damping_ratio=DAMPING, modes=1),
    actuators=[jb.PointForce(DAMPER)],
    sensors=[jb.Sensor(DAMPER, "velocity"), jb.Sensor(SENSOR)],
    loads=[jb.MovingForce(force=FORCE, speed=SPEED)],
    controller=jb.SemiActive(LEAST, MOST, desired=jb.Feedback([5e6]), period=DAMPER_PERIOD),
    run=jb.Run(DAMPER_HOLDS * DAMPER_PERIOD, sample_rate=PARTS / DAMPER_PERIOD),
)


def transitions():
    """Matrices of the mode over a part of a hold, on and off the beam: q, q', sin, cos, force."""
    omega, turn = (np.pi / L) ** 2 * np.sqrt(EI / MASS), np.pi * SPEED / L
    modal_mass = MASS * L / 2
    found = []
    for load in (-FORCE / modal_mass, 0.0):
        A = np.zeros((5, 5))
        A[0, 1], A[1, 0], A[1, 1] = 1.0, -(omega**2), -2 * DAMPING * omega
        A[1, 2], A[1, 4] = load, np.sin(np.pi * DAMPER / L) / modal_mass
        A[2, 3], A[3, 2] = turn, -turn
        found.append(expm(A * DAMPER_PERIOD / PARTS))
    return found


def runs(damper_force):
    """Deflections at the sensor (sample, run); the force is a function of hold and velocity."""
    on_beam, off_beam = transitions()
    shapes = np.sin(np.pi * np.array([DAMPER, SENSOR]) / L)
    state = np.array([0.0, 0.0, 0.0, 1.0, 0.0])[:, None]
    deflection = []
    for k in range(DAMPER_HOLDS):
        force = damper_force(k, shapes[0] * state[1])
        state = np.concatenate(
            [np.broadcast_to(state[:4], (4, force.size)), np.atleast_2d(force)], axis=0
        )
        for part in range(PARTS):
            crossing = SPEED * (k + part / PARTS) * DAMPER_PERIOD < L * (1 - 1e-9)
            state = (on_beam if crossing else off_beam) @ state
            deflection.append(shapes[1] * state[0])
    return np.array(deflection)


def test_no_sequence_of_rates_has_a_smaller_peak():
    found = damper_peak(DAMPED, positions=[SENSOR])
    rates = np.array(list(itertools.product(np.geomspace(LEAST, MOST, 6), repeat=DAMPER_HOLDS)))
    everything = np.abs(runs(lambda k, velocity: -rates[:, k] * velocity)).max(axis=0)
    assert found.peak <= everything.min() * (1 + 1e-9)
    assert found.peak > 0.9 * everything.min()  # rates between those of the table gain little

    velocities = []

    def given(k, velocity):
        velocities.append(float(velocity[0]))
        return found.forces[k]

    assert_allclose(np.abs(runs(given)).max(), found.peak, rtol=1e-6)
    ratio = -found.forces[1:, 0] / np.array(velocities[1:])  # at rest there is no force
    assert np.all((ratio > LEAST * (1 - 1e-5)) & (ratio < MOST * (1 + 1e-5)))
    without = np.abs(runs(lambda k, velocity: np.zeros(1))).max()
    assert_allclose(found.uncontrolled, without, rtol=1e-6)


def test_a_comparison_says_what_the_dampers_attain():
    free = dataclasses.replace(DAMPED, controller=None)
    laws = {
        "clipped": DAMPED.controller,
        "constant": dataclasses.replace(DAMPED.controller, min_damping=MOST),
    }
    found = compare(free, laws)
    clipped = found.damper_peaks["clipped"]
    assert found.bound.peak < clipped.peak < found.metrics["clipped"].peak
    assert clipped.peak <= found.damper_peaks["constant"].peak * (1 + 1e-9)
    assert f"clipped: {clipped.verdict}; the law achieves " in " ".join(found.remarks)
    without_effect = dataclasses.replace(DAMPED.controller, min_damping=0.0, max_damping=0.0)
    none = compare(free, {"none": without_effect})
    assert none.damper_summary("none") == none.damper_peaks["none"].verdict
    assert none.damper_peaks["none"].peak == none.damper_peaks["none"].uncontrolled
    # A damper of one rate has one run.
    constant = found.damper_peaks["constant"]
    assert_allclose(constant.peak, found.metrics["constant"].peak, rtol=1e-3)


def test_a_comparison_says_why_no_peak_of_dampers_is_found():
    """It left them out without a word. At 1 cm/s the smallest rate takes a thousand times 8 N."""
    weak = [jb.PointForce(DAMPER, limits=[-8.0, 8.0])]
    case = dataclasses.replace(DAMPED, controller=None, actuators=weak)
    stiff = dataclasses.replace(DAMPED.controller, min_damping=8e5)
    found = compare(case, {"stiff": stiff})
    assert found.damper_peaks["stiff"].endswith("raise the limits, or lower min_damping")
    assert "stiff: no peak that its dampers attain: no forces" in " ".join(found.remarks)


def test_long_runs_have_longer_holds_and_other_laws_are_refused():
    law = dataclasses.replace(DAMPED.controller, period=0.002)
    found = damper_peak(dataclasses.replace(DAMPED, controller=law))
    assert found.times.size <= 200 and found.period == pytest.approx(0.004)
    with pytest.raises(ValueError, match="controller must be of kind semi-active"):
        damper_peak(dataclasses.replace(DAMPED, controller=jb.Feedback([1.0])))


LIMITS, SHORT_PERIOD = [-1.0, 1.5], 0.015


def beam_case(controller=None, limits=LIMITS) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(0.2, limits=limits), jb.PointForce(0.4, limits=limits)],
        sensors=[jb.Sensor(0.25), jb.Sensor(0.4)],
        loads=[jb.MovingForce(mass=0.4, speed=2.5)],
        controller=controller,
        run=jb.Run(0.3, 1000.0),
    )


@pytest.fixture(scope="module")
def least():
    return least_integral(beam_case(), weights=[1.0, 3.0], period=SHORT_PERIOD)


def problem(case):
    """Matrix and right side of the least squares, rows weighted by the trapezoidal rule."""
    influence = input_influence(case, np.array([0.25, 0.4]), SHORT_PERIOD, 1e-3)
    weight = np.convolve(np.diff(influence.times), [0.5, 0.5])
    rows, right = [], []
    for row, share in zip(influence.deflection_rows, [1.0, 3.0], strict=True):
        scale = np.sqrt(share * weight)
        response = np.tensordot(influence.response, row, axes=(1, 0)).reshape(scale.size, -1)
        rows.append(scale[:, None] * response)
        right.append(-scale * (influence.unforced @ row))
    return np.concatenate(rows), np.concatenate(right)


def test_against_scipy(least):
    matrix, right = problem(beam_case())
    low, high = (np.full(matrix.shape[1], limit) for limit in LIMITS)
    scale = 1 / np.linalg.norm(matrix, axis=0).max()
    solved = lsq_linear(
        matrix * scale, right, (low / scale, high / scale), method="bvls", tol=1e-14
    )
    expected = np.sum((matrix @ (solved.x * scale) - right) ** 2)
    assert_allclose(least.uncontrolled, right @ right, rtol=1e-12)
    assert_allclose(least.integral, expected, rtol=1e-7)
    assert least.proven <= expected * (1 + 1e-12)
    assert_allclose(least.proven, expected, rtol=1e-5)


def test_commands_are_at_the_limits():
    """Bang-bang, as the thesis says of this criterion, where limits are tight, but for the end."""
    least = least_integral(beam_case(limits=[-0.3, 0.3]), period=SHORT_PERIOD)
    crossing = least.commands[: int(0.6 / 2.5 / SHORT_PERIOD)]
    assert np.abs(least.commands).max() <= 0.3
    assert np.mean(np.abs(crossing) > 0.3 * (1 - 1e-6)) > 0.85
    assert 0.5 < least.share_at_limits < 1.0
    assert 0.1 < least.reduction < 0.6


def test_a_run_has_the_integral_and_no_law_less(least):
    """Feedback, and the commands of the least peak, are above it."""
    found = jb.simulate(beam_case(least.controller()))
    assert_allclose(least.of_record(found), least.integral, rtol=1e-5)
    feedback = jb.Feedback([200.0, 200.0], period=SHORT_PERIOD)
    for law in (feedback, jb.bound(beam_case(), period=SHORT_PERIOD).controller()):
        assert least.proven < least.of_record(jb.simulate(beam_case(law))) < least.uncontrolled


def test_limits_of_rates():
    """Commands keep them, and a linear program of scipy proves that none are better."""
    patch = {"correction": 0.3, "amplifier_gain": 200.0, "limits": [-2.5, 7.5]}
    free, limited = (
        dataclasses.replace(beam_case(), actuators=(jb.Patch(0.25, 0.35, 8.3e-4, **patch, **rate),))
        for rate in ({}, {"rate_limit": 60.0})
    )
    fast, slow = (least_integral(case, period=SHORT_PERIOD) for case in (free, limited))
    assert np.abs(np.diff(slow.commands, axis=0, prepend=0.0)).max() <= 60.0 * SHORT_PERIOD * (
        1 + 1e-12
    )
    assert 1.02 * fast.integral < slow.proven <= slow.integral
    assert slow.integral - slow.proven < 1e-6 * slow.uncontrolled


def test_errors():
    unlimited = dataclasses.replace(beam_case(), actuators=(jb.PointForce(0.2),))
    with pytest.raises(ValueError, match=r"^actuators.0.limits must be given"):
        least_integral(unlimited)
    with pytest.raises(ValueError, match="weights must list 2 numbers"):
        least_integral(beam_case(), weights=[1.0])
