"""Position-scheduled feedforward: commands against numpy and against prescribed ones."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement

SHARES = [0.0, 0.2, 0.7, 1.0]
VALUES = [[0.5, 6.0, 4.0, 1.0]]
LAW = jb.Feedforward(gates=[-0.2, -0.1], shares=SHARES, values=VALUES, period=0.01, lead=0.02)


ONE = (jb.MovingMass(mass=0.4, speed=1.0, entry_time=0.3),)


def beam_case(controller=LAW, loads=ONE):
    return jb.Case(
        jb.Beam(0.6, 13.2, 0.81, 0.03, modes=1),
        actuators=[jb.Patch(0.25, 0.35, 8.3e-4, correction=0.3, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.3)],
        loads=list(loads),
        controller=controller,
        run=jb.Run(duration=1.2, sample_rate=100.0),
    )


def commands(case, times):
    plant = jb.state_space(case)
    measurement = Measurement(jnp.zeros(1), jnp.zeros(2), jnp.zeros(1))

    @eqx.filter_jit
    def commands_at_times(controller, plant):
        law = controller.law(plant)
        return jax.vmap(lambda t: law.step((), measurement, t).command)(times)[:, 0]

    return commands_at_times(case.controller, plant)


def test_table_is_read_ahead_of_the_load_after_the_second_gate():
    times = np.linspace(0.0, 1.2, 301)
    share = np.round((times + 0.02 - 0.3) * 1.0 / 0.6, 12)  # 0 and 1 are of the table
    expected = np.interp(share, SHARES, VALUES[0], left=0.0, right=0.0)
    assert_allclose(commands(beam_case(), times), expected, atol=1e-12)
    late = dataclasses.replace(LAW, gates=np.array([0.1, 0.2]))
    assert_allclose(
        commands(beam_case(late), times), np.where(times < 0.5, 0.0, expected), atol=1e-12
    )


def test_run_equals_that_with_prescribed_commands():
    record = jb.simulate(beam_case())
    table = np.asarray(commands(beam_case(), record.times))
    prescribed = jb.Prescribed(offsets=[0.0], times=record.times, values=table[None], period=0.01)
    assert_allclose(record.command[:, 0], table, atol=1e-9)
    assert_allclose(record.deflection, jb.simulate(beam_case(prescribed)).deflection, atol=1e-12)


def test_load_from_the_right_and_several_loads():
    times = np.linspace(0.003, 1.203, 61)  # not at the jumps of the table
    right = (jb.MovingMass(mass=0.4, speed=-1.0, entry_time=0.3),)
    mirrored = dataclasses.replace(LAW, gates=np.array([0.8, 0.7]))
    first = commands(beam_case(), times)
    assert_allclose(commands(beam_case(mirrored, right), times), first, atol=1e-12)
    both = (*ONE, jb.MovingMass(mass=0.2, speed=1.0, entry_time=0.5))
    later = commands(beam_case(loads=both[1:]), times)
    assert_allclose(commands(beam_case(loads=both), times), first + later, atol=1e-12)


CONFIRMED = dataclasses.replace(LAW, confirmation=np.asarray(2e-5))


def test_gates_that_fire_without_a_load_leave_the_beam_alone():
    """A load without weight passes the gates: the table alone lifts the beam by 0.2 mm."""
    nothing = (jb.MovingMass(mass=1e-9, speed=1.0, entry_time=0.3),)
    lifted = jb.simulate(beam_case(loads=nothing))
    assert float(np.max(lifted.deflection)) > 2e-4
    at_rest = jb.simulate(beam_case(CONFIRMED, nothing))
    assert not np.any(at_rest.command) and float(np.max(np.abs(at_rest.deflection))) < 1e-9


def test_a_load_that_a_sensor_shows_is_answered_by_the_table():
    """Commands are those of the table from the first sample at which the beam has gone down."""
    record = jb.simulate(beam_case(CONFIRMED))
    table = np.asarray(commands(beam_case(), record.times))
    shown = np.asarray(record.deflection)[:, 0] <= -2e-5
    first = int(np.argmax(shown))
    assert 0.3 < record.times[first] < 0.35
    expected = np.where(np.arange(table.size) < first, 0.0, table)
    assert_allclose(record.command[:, 0], expected, atol=1e-9)


def test_a_load_that_shows_too_late_is_not_confirmed():
    """The first passage is without a load; the second load shows after its time is out."""
    loads = (
        jb.MovingMass(mass=1e-9, speed=1.0, entry_time=0.2),
        jb.MovingMass(mass=0.4, speed=1.0, entry_time=0.5),
    )
    run = jb.simulate(beam_case(CONFIRMED, loads))
    alone = jb.simulate(beam_case(CONFIRMED, loads[1:]))
    assert_allclose(run.command, alone.command, atol=1e-9)
    none = dataclasses.replace(beam_case(CONFIRMED), sensors=())
    with pytest.raises(ValueError, match="confirmation needs a sensor of the deflection"):
        jb.simulate(none)


def test_errors_of_settings():
    case = beam_case()
    slow = (jb.MovingMass(mass=0.4, speed=0.1, deceleration=0.1),)
    for changes, loads, message in (
        ({"period": None}, case.loads, "period must be given"),
        ({"values": np.ones((1, 3))}, case.loads, "values must have for each of 1 actuators"),
        ({"gates": np.array([0.2, 0.1])}, case.loads, "gates must be two positions"),
        ({"gates": np.array([0.1, 0.4])}, slow, "gates must be two positions"),
        ({}, (), "kind needs loads"),
    ):
        with pytest.raises(ValueError, match=message):
            jb.simulate(beam_case(dataclasses.replace(LAW, **changes), loads))
