"""Least achievable peak: certificate of optimality, another solver, runs with and without it."""

import dataclasses
import json

import clarabel
import jax
import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose
from scipy.optimize import OptimizeResult, linprog

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import bound, input_influence, least_peak
from tests.modules import DATA as DATA_FOLDER

DATA = json.loads((DATA_FOLDER / "bounds.json").read_text())
PATCH = jb.Patch(
    0.2575,
    0.3425,
    moment_per_volt=DATA["one span, one mass"]["moment_per_volt"],
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
    expected, case = DATA[name], patched(modes)
    influence = input_influence(case, np.array([0.3]), 0.01, 0.01)
    uncontrolled = np.max(np.abs(influence.deflection(np.zeros((60, 1)))))
    assert_allclose(uncontrolled, expected["uncontrolled_m"], rtol=2e-9)
    # The programs of the reference are in metres, with feasibility tolerances of 1e-7.
    assert_allclose(bound(case, spacing=0.01).peak, expected["least_peak_m"], rtol=0, atol=1.1e-7)


@pytest.mark.parametrize("row", DATA["attainable_reduction_percent"])
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
