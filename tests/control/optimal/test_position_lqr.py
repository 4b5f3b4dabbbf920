"""Gains of single loads read by the positions of several loads, of varying speed."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import Estimate
from jaxbeam.case.validation import check_case
from jaxbeam.control.optimal.crossing_gains import GainSchedule, PositionGainLaw
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.gain_table import GainTable
from tests.differences import central

WEIGHTS = {"state_weight": [1e4, 1.0], "command_weight": [1e-3], "points": 40}
BRAKING = jb.MovingMass(mass=0.3, speed=2.0, entry_time=0.1, deceleration=1.5)
SECOND = jb.MovingMass(mass=0.2, speed=2.5, entry_time=0.2)
LENGTH, MASSES, SPEEDS = 0.6, np.array([0.1, 0.4]), np.array([1.0, 3.0])
REST = Measurement(np.zeros(1), np.zeros(2), np.zeros(1))


def beam_case(controller, loads=(BRAKING,), duration=0.7) -> jb.Case:
    return jb.Case(
        jb.Beam(LENGTH, 11.68, 0.535, 0.03, modes=1),
        actuators=[jb.PointForce(0.25)],
        sensors=[jb.Sensor(0.3)],
        loads=list(loads),
        controller=controller,
        run=jb.Run(duration, 200.0),
    )


def polynomial_law(loads) -> PositionGainLaw:
    """Law whose gains of the two states and the weight are known polynomials of the position.

    K(m, v, x) = (m + v) (1 + 2 s, s, s^2) at a share s, linear in mass and speed.
    """
    powers = np.array([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    ends, zero, fade = np.array([0.0, 1.0]), np.zeros(()), np.array(0.05)

    def schedule(size):
        table, final = GainTable(ends, size * powers[None, :, None]), size * np.eye(1, 3) * 5.0
        return GainSchedule(table, final, np.zeros(1), zero, np.ones(()), fade, True)

    designs = [schedule(mass + speed) for mass in MASSES for speed in SPEEDS]
    schedules = jax.tree.map(lambda *x: jnp.stack(x).reshape(2, 2, *x[0].shape), *designs)
    mass = jnp.array([float(load.mass) for load in loads])
    moving = load_set(beam_case(None, loads))
    return PositionGainLaw(schedules, MASSES, SPEEDS, mass, 9.81 * mass, moving)


def expected_command(loads, x, t):
    """Command by the positions x = v t - a t^2 / 2 of loads that enter at the left."""
    feedback, forward, total = np.zeros(2), 0.0, 0.0
    for load in loads:
        since = t - float(load.entry_time)
        position = float(load.speed) * since - float(load.deceleration) * since**2 / 2
        speed = float(load.speed) - float(load.deceleration) * since
        share, mass = position / LENGTH, float(load.mass)
        if since < 0 or share > 1:
            continue
        size = mass + speed
        feedback += mass * size * np.array([1 + 2 * share, share])
        forward += size * share**2 * mass * 9.81
        total += mass
    return -feedback @ x / total - forward


@pytest.mark.parametrize("t", [0.15, 0.23, 0.3, 0.42])
def test_gains_are_read_by_position_and_combined(t):
    """First one load, then two, then the one that brakes alone: it stays longer than at 2 m/s."""
    loads, x = (BRAKING, SECOND), np.array([0.7, -0.4])
    command = polynomial_law(loads).step((), Estimate(jnp.asarray(x)), REST, jnp.asarray(t)).command
    assert_allclose(command, expected_command(loads, x, t), rtol=1e-9)


def test_before_the_entry_and_after_the_exit():
    """Then the final gain of the loads fades, each from its own exit, averaged by mass."""
    law, x = polynomial_law((BRAKING, SECOND)), Estimate(jnp.array([1.0, 0.0]))
    assert law.step((), x, REST, jnp.asarray(0.05)).command == 0.0
    leave = np.array([0.1 + (2.0 - np.sqrt(4.0 - 2 * 1.5 * LENGTH)) / 1.5, 0.2 + LENGTH / 2.5])
    gone = 0.6 - leave
    exit_speeds = np.array([2.0 - 1.5 * (0.6 - 0.1), 2.5])
    sizes = np.array([0.3, 0.2]) + np.maximum(exit_speeds, 1.0)
    expected = np.array([0.3, 0.2]) @ (5.0 * sizes * np.exp(-gone / 0.05)) / 0.5
    assert_allclose(law.step((), x, REST, jnp.asarray(0.6)).command, -expected, rtol=1e-9)


def test_derivative_by_masses_and_time():
    law, x = polynomial_law((BRAKING, SECOND)), Estimate(jnp.array([0.7, -0.4]))

    @jax.jit
    def command(numbers):
        mass = jnp.asarray(numbers[:2])
        changed = dataclasses.replace(law, load_masses=mass, load_weights=9.81 * mass)
        return changed.step((), x, REST, jnp.asarray(numbers[2])).command

    point = jnp.array([0.3, 0.2, 0.3])
    expected = central(command, point, 1e-3)
    assert_allclose(jax.jit(jax.jacfwd(command))(point), expected, rtol=1e-7)


def regulators():
    single = jb.LQR(**WEIGHTS, horizon="crossing")
    return single, jb.LQR(**WEIGHTS, masses=[0.3], horizon="crossing", schedule="positions")


def test_one_load_of_the_design_at_constant_speed():
    """The commands are those of the optimal regulator, by time."""
    steady = (eqx.tree_at(lambda load: load.deceleration, BRAKING, np.zeros(())),)
    times, x = jnp.array([0.12, 0.25, 0.38]), jnp.array([1e-3, 2e-2])

    @eqx.filter_jit
    def commands(case, layout):
        law = case.controller.law(jb.state_space(case, layout=layout)).law
        return jnp.stack([law.step((), Estimate(x), REST, t).command for t in times])

    cases = [beam_case(law, steady) for law in regulators()[::-1]]
    found, expected = (commands(case, mesh_layout(case)) for case in cases)
    assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("settings", "loads", "message"),
    [
        ({}, (jb.MovingForce(mass=0.2, times=[0.0, 0.3], positions=[0.0, 0.5]),), "speeds must"),
        (
            {},
            (BRAKING, jb.MovingMass(mass=0.2, speed=-1.0)),
            "schedule needs loads that all travel in one direction",
        ),
        ({"masses": []}, (BRAKING,), "masses must list at least one"),
        ({"entries": "predicted"}, (BRAKING,), "entries must be 'measured'"),
        ({}, (jb.Oscillator(0.3, 900.0, 2.0, speed=15.0),), "schedule needs loads of one wheel"),
    ],
)
def test_errors_of_settings(settings, loads, message):
    law = jb.LQR(
        **WEIGHTS, **({"masses": [0.2]} | settings), horizon="crossing", schedule="positions"
    )
    with pytest.raises(ValueError, match=f"^controller.{message}"):
        check_case(beam_case(law, loads))
