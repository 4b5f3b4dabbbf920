"""Actuators: limits of commands, moment of a patch, electromechanics of a coil."""

import dataclasses
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import held_command_limits
from jaxbeam.analysis.sections import coil_history
from jaxbeam.case.case import addresses, replace
from jaxbeam.case.validation import check_case
from jaxbeam.export.fmi import BeamSteps
from jaxbeam.model.frequency_responses import frequency_response
from jaxbeam.simulation.commands import acting_ranges, command_operator, with_exact_compensation
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.stored_record import record_from_xarray
from tests.differences import central

# Smart Material M8557-P1 on rig B of the thesis: sections 2.4.1 and 2.4.2.
MATERIAL = {
    "d33": 460e-12,
    "modulus": 30.336e9,
    "electrode_spacing": 407.18e-6,
    "beam_height": 2.83e-3,
    "patch_height": 0.3e-3,
    "patch_width": 57e-3,
}
V4 = jb.Electrodynamic(0.5, 0.82, 5e-5, 4.2, mass=0.02, stiffness=9700.0, damping=0.55)  # table 2.3


def test_moment_per_volt_from_material():
    patch = jb.Patch(0.2575, 0.3425, correction=0.32, amplifier_gain=200.0, **MATERIAL)
    assert_allclose(patch.moment_constant, 8.2924e-4, rtol=1e-5)
    direct = jb.Patch(0.2575, 0.3425, patch.moment_constant, correction=0.32, amplifier_gain=200.0)
    assert_allclose(patch.attachment().static_gain, direct.attachment().static_gain, rtol=1e-15)
    assert_allclose(patch.attachment().static_gain, 8.2924e-4 * 0.32 * 200, rtol=1e-5)


def test_material_numbers_have_addresses():
    case = jb.Case(jb.Beam(0.6, 13.211, 0.812), actuators=[jb.Patch(0.2575, 0.3425, **MATERIAL)])
    found = addresses(case)
    for name, value in MATERIAL.items():
        assert_allclose(found[f"actuators.0.{name}"], value)
    changed = replace(case, {"actuators.0.d33": 230e-12})
    assert_allclose(changed.actuators[0].moment_constant, case.actuators[0].moment_constant / 2)


@pytest.mark.parametrize(
    ("given", "gain", "expected"),
    [
        (None, 1.0, [-500.0, 1500.0]),
        (None, 200.0, [-2.5, 7.5]),
        ([-1.25, 7.0], 200.0, [-1.25, 7.0]),
        ([-10.0, 5.0], 200.0, [-2.5, 5.0]),
        ([-1.0, 10.0], 200.0, [-1.0, 7.5]),
    ],
)
def test_command_limits_of_a_patch_include_depolarisation(given, gain, expected):
    patch = jb.Patch(
        start=0.2, end=0.3, moment_per_volt=1e-3, amplifier_gain=gain, limits=given, rate_limit=50.0
    )
    assert_allclose(patch.command_limits(), expected)
    assert patch.command_rate_limit() == 50.0


def test_command_limits_of_other_actuators():
    limited = [jb.PointForce(position=0.1, limits=[-1, 2]), jb.Shaker(position=0.1, limits=[-1, 2])]
    for actuator in limited:
        assert_allclose(actuator.command_limits(), [-1, 2])
    for actuator in (jb.PointForce(0.1), jb.Shaker(0.1), V4, jb.SpringDamper(0.1)):
        assert actuator.command_limits() is None
        assert actuator.command_rate_limit() is None
    assert jb.Patch(0.1, 0.2, 1e-3).command_rate_limit() is None


def test_static_gains():
    assert_allclose(V4.attachment().static_gain, 4.2 / 0.82, rtol=1e-15)
    assert_allclose(jb.Shaker(0.1, force_per_volt=4.6).attachment().static_gain, 4.6, rtol=1e-15)
    assert jnp.ndim(jb.PointForce(0.1).attachment().static_gain) == 0


# Inner loops of a shaker against the equations of its coil, by scipy and in closed form.

R, L, KF, KV, MASS, DAMPING, STIFFNESS = 0.82, 5e-3, 4.2, 3.9, 0.03, 0.55, 900.0
PLACE, GAIN, PERIOD, SPEED, DURATION = 0.35, 300.0, 0.01, 6.0, 0.12
BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2)
LOOPS = {
    "current": jb.actuators.CurrentLoop(bandwidth=900.0),
    "current, proportional": jb.actuators.CurrentLoop(proportional=3.0),
    "force": jb.actuators.ForceLoop(proportional=0.4, integral=90.0),
    "force, with the lag of its sensor": jb.actuators.ForceLoop(
        bandwidth=150.0, sensor_bandwidth=2000.0
    ),
}


def shaker(loop=None, **changes) -> jb.Electrodynamic:
    numbers = {"mass": MASS, "stiffness": STIFFNESS, "damping": DAMPING}
    return jb.Electrodynamic(PLACE, R, L, KF, KV, **(numbers | changes), inner_loop=loop)


def crossing(*actuators, **changes) -> jb.Case:
    parts = {
        "sensors": [jb.Sensor(0.3)],
        "loads": [jb.MovingMass(0.1, SPEED)],
        "controller": jb.Feedback([GAIN], period=PERIOD),
        "run": jb.Run(DURATION, 1 / PERIOD),
    }
    return jb.Case(BEAM, actuators=actuators, **(parts | changes))


def by_its_equations(
    loop, times, gain=GAIN, limits=(-np.inf, np.inf), sampled=True, reading=None, rigidity=11.68
):
    """Deflection at the sensor, current and voltage, by scipy from sine modes and the coil.

    A command follows from `reading(k, w)`, with w at time k, or from w itself.

    States: coordinates, rates, current, integral of the error, what the sensor shows of the force.
    Where the voltage reaches its limits, and leaves them, are events at which scipy starts anew.
    """
    wave = np.arange(1, 3) * np.pi / 0.6
    omega = wave**2 * np.sqrt(rigidity / 0.535)
    size = np.sqrt(2 / (0.535 * 0.6))
    at_coil, at_sensor = size * np.sin(wave * PLACE), size * np.sin(wave * 0.3)
    of_force = isinstance(loop, jb.actuators.ForceLoop)
    output = KF if of_force else 1.0
    p = L * loop.bandwidth / output if loop.proportional is None else loop.proportional
    q = R * loop.bandwidth / output if loop.bandwidth is not None else loop.integral or 0.0

    lag = loop.sensor_bandwidth if of_force else None

    def rates(t, y, command, held=None):
        """Rates, with the voltage that the loop asks for, or with the one at which it is held."""
        coordinates, velocity, current, integral, shown = y[:2], y[2:4], *y[4:]
        mass = np.eye(2) + MASS * np.outer(at_coil, at_coil)
        suspension = DAMPING * at_coil @ velocity + STIFFNESS * at_coil @ coordinates
        force = -2 * 0.03 * omega * velocity - omega**2 * coordinates
        force += at_coil * (KF * current - suspension)
        if t <= 0.6 / SPEED:
            shape = size * np.sin(wave * SPEED * t)
            slope = size * wave * np.cos(wave * SPEED * t)
            bending = SPEED**2 * -(wave**2) * shape @ coordinates
            mass += 0.1 * np.outer(shape, shape)
            force -= 0.1 * shape * (9.81 + 2 * SPEED * slope @ velocity + bending)
        acceleration = np.linalg.solve(mass, force)
        measured = current
        if of_force:
            measured = KF * current - suspension - MASS * at_coil @ acceleration
        if command is None:  # in continuous time
            command = -gain * at_sensor @ coordinates
        error = command - (measured if lag is None else shown)
        volts = asked = p * error + q * integral
        if held is not None:
            volts, error = held, error + (held - asked) / p
        rise = (volts - R * current - KV * at_coil @ velocity) / L
        follow = 0.0 if lag is None else lag * (measured - shown)
        return [*velocity, *acceleration, rise, error, follow]

    def volts_asked(t, y, command, held=None):
        return L * rates(t, y, command)[4] + R * y[4] + KV * at_coil @ y[2:4]

    def passing(limit, direction):
        def event(t, y, command, held):
            return volts_asked(t, y, command) - limit

        event.terminal, event.direction = True, direction
        return event

    limited = np.isfinite(limits).all()
    options = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-11}
    if limited:
        options = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}

    def until(start, end, first, command):
        """State at the end of a period, from one event of the voltage to the next."""
        asked = volts_asked(start, first, command)
        held = None if limits[0] < asked < limits[1] else float(np.clip(asked, *limits))
        while True:
            events = [passing(limits[0], -1), passing(limits[1], 1)] if limited else None
            if held is not None:
                events = [passing(held, 1 if held == limits[0] else -1)]
            found = solve_ivp(
                rates, (start, end), first, args=(command, held), events=events, **options
            )
            start, first = found.t[-1], found.y[:, -1]
            if found.status == 0:
                return first
            held = None if held is not None else limits[int(found.t_events[1].size > 0)]

    history, volts = [np.zeros(7)], []
    for start, end in itertools.pairwise(times):
        first = history[-1]
        read = at_sensor @ first[:2]
        read = read if reading is None else reading(len(history) - 1, read)
        command = -gain * read if sampled else None
        # The voltage of the beginning period, from L I' = u - R I - K_v w'.
        volts.append(np.clip(volts_asked(start, first, command), *limits))
        history.append(until(start, end, first, command))
    history = np.array(history)
    return history[:, :2] @ at_sensor, history[:, 4], np.array(volts)


@pytest.mark.parametrize("name", LOOPS)
def test_crossing_under_outer_feedback(name):
    case = crossing(shaker(LOOPS[name]))
    record, coil = jb.simulate(case), coil_history(case)
    expected, *of_coil = by_its_equations(LOOPS[name], np.asarray(record.times))
    assert_allclose(record.deflection[:, 0], expected, atol=1e-6 * np.abs(expected).max())
    for history, own in zip((coil.current, coil.voltage[:-1]), of_coil, strict=True):
        assert_allclose(history, own, atol=1e-6 * np.abs(own).max())


LIMITED = {
    "current": [-0.2, 0.3],
    "current, proportional": [-0.2, 0.3],
    "force, with the lag of its sensor": [-0.02, 0.06],
}


@pytest.mark.parametrize("sampled", [True, False])
@pytest.mark.parametrize("name", LIMITED)
def test_a_voltage_that_reaches_its_limits(name, sampled):
    limits = np.array(LIMITED[name]) * (1.0 if sampled else 0.2)
    law = jb.Feedback([1e3], period=PERIOD if sampled else None)
    case = crossing(shaker(LOOPS[name], limits=limits), controller=law)
    record, coil = jb.simulate(case), coil_history(case)
    assert np.isin(limits, coil.voltage).any()
    times = np.asarray(record.times)
    expected, *of_coil = by_its_equations(LOOPS[name], times, 1e3, limits, sampled)
    assert_allclose(record.deflection[:, 0], expected, atol=1e-6 * np.abs(expected).max())
    for history, own in zip((coil.current, coil.voltage[:-1]), of_coil, strict=True):
        assert_allclose(history, own, atol=1e-6 * np.abs(own).max())


def test_limits_of_the_voltage_in_sweeps_and_derivatives():
    actuator = shaker(LOOPS["current"], limits=[-0.2, 0.3])
    case = crossing(actuator, controller=jb.Feedback([1e3], period=PERIOD))
    masses = np.array([0.08, 0.1, 0.13])
    found = jb.sweep(case, {"loads.0.mass": masses}).peak_deflection[:, 0]
    peaks = [jb.simulate(jb.replace(case, {"loads.0.mass": m})).peak_deflection[0] for m in masses]
    assert_allclose(found, peaks, rtol=1e-6)
    plan = integration_plan(case, tolerance=1e-9)

    def last(numbers):
        names = "actuators.0.limits", "actuators.0.inner_loop.bandwidth", "loads.0.mass"
        changes = dict(zip(names, (numbers[:2], *numbers[2:]), strict=True))
        return jb.simulate(jb.replace(case, changes), plan=plan).deflection[-1, 0]

    point = np.array([-0.2, 0.3, 900.0, 0.1])
    derivative = jax.jit(jax.grad(last))(point)
    assert_allclose(derivative, central(last, point), rtol=1e-5, atol=1e-9)


def test_where_limits_of_the_voltage_are_refused():
    case = crossing(shaker(LOOPS["current"], limits=[-0.2, 0.3]))
    with pytest.raises(ValueError, match="within its inner loop, and a bound is that of a linear"):
        jb.bound(case)
    with pytest.raises(ValueError, match="and an exported beam is linear"):
        BeamSteps(case)
    free = dataclasses.replace(case, controller=None)
    with pytest.raises(ValueError, match="in runs under a controller only: give one"):
        jb.simulate(free)
    assert jb.modes(free).frequencies.size == 2


@pytest.mark.parametrize(
    ("loop", "gain", "stiffness"),
    [
        (jb.actuators.CurrentLoop(bandwidth=900.0), KF, STIFFNESS),
        (jb.actuators.CurrentLoop(proportional=3.0), KF * 3.0 / (3.0 + R), STIFFNESS),
        (jb.actuators.ForceLoop(bandwidth=900.0, sensor_bandwidth=50.0), 1.0, 0.0),
        # F = K_f I - k s with I = P (u - F) / R.
        (
            jb.actuators.ForceLoop(proportional=3.0),
            3.0 * KF / (R + 3.0 * KF),
            STIFFNESS * R / (R + 3.0 * KF),
        ),
    ],
)
def test_steady_force(loop, gain, stiffness):
    attachment = shaker(loop).attachment()
    assert_allclose(attachment.static_gain, gain, rtol=1e-12)
    assert_allclose(attachment.stiffness, stiffness, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", LOOPS)
def test_voltage_over_current_is_the_impedance(name):
    """Eq. (2.26) of the thesis holds whatever sets the voltage, and (2.33) for the forces."""
    case = jb.Case(BEAM, actuators=[shaker(LOOPS[name])])
    frequencies = np.array([3.0, 26.0, 90.0, 700.0])
    outputs = ("current", "voltage", "active_force", "transmitted_force")
    pairs = [("actuators.0", f"actuators.0.{output}") for output in outputs]
    found = np.asarray(frequency_response(case, frequencies, pairs).values)
    s = 2j * np.pi * frequencies
    wave = np.arange(1, 3) * np.pi / 0.6
    omega, shape = wave**2 * np.sqrt(11.68 / 0.535), np.sqrt(2 / 0.321) * np.sin(wave * PLACE)
    beam = s * sum(a**2 / (s**2 + 0.06 * w * s + w**2) for a, w in zip(shape, omega, strict=True))
    mechanical = MASS * s + DAMPING + STIFFNESS / s
    impedance = R + s * L + KF * KV / (1 / beam + mechanical)
    assert_allclose(found[:, 1] / found[:, 0], impedance, rtol=1e-9)
    assert_allclose(found[:, 2], KF * found[:, 0], rtol=1e-12)
    assert_allclose(found[:, 3] / found[:, 2], 1 / (1 + beam * mechanical), rtol=1e-9)


@pytest.mark.parametrize(
    ("actuator", "message"),
    [
        (
            shaker(jb.actuators.CurrentLoop()),
            "actuators.0.inner_loop.proportional is missing; give it, or",
        ),
        (
            shaker(jb.actuators.CurrentLoop(bandwidth=1.0, integral=2.0)),
            "actuators.0.inner_loop.integral contradicts bandwidth",
        ),
        (
            shaker(jb.actuators.ForceLoop(bandwidth=1.0), limits=[-5.0, 5.0]),
            "actuators.0.inner_loop.sensor_bandwidth is missing: with limits of the voltage",
        ),
        (
            shaker(jb.actuators.ForceLoop(bandwidth=-1.0)),
            "actuators.0.inner_loop.bandwidth must be positive",
        ),
    ],
)
def test_errors(actuator, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(crossing(actuator))


def test_a_patch_has_no_coil():
    with pytest.raises(ValueError, match="actuators.0 is no electrodynamic shaker"):
        coil_history(crossing(jb.PointForce(PLACE)))


def test_commands_stay_within_the_limits_of_the_loop():
    limited = shaker(jb.actuators.CurrentLoop(bandwidth=900.0, limits=[-0.1, 0.2]))
    law = jb.Feedback([8e3], period=PERIOD)
    record = jb.simulate(crossing(limited, controller=law))
    assert_allclose([np.min(record.command), np.max(record.command)], [-0.1, 0.2], rtol=1e-12)
    assert limited.command_unit == "A"


def test_a_loop_that_the_beam_makes_unstable_is_warned_of():
    steady, wild = (
        jb.actuators.ForceLoop(bandwidth=b, sensor_bandwidth=30.0) for b in (1.0, 1000.0)
    )
    assert not any("inner_loop" in line for line in jb.check(crossing(shaker(steady))).warnings)
    assert any("inner_loop" in line for line in jb.check(crossing(shaker(wild))).warnings)


# Hysteresis of actuators: properties of the operator, its inverse, and loops with both.

OPERATOR = jb.actuators.Hysteresis([0.0, 0.5, 1.5, 3.0], [0.7, 0.15, 0.1, 0.15])
COMMANDS = arrays(float, st.integers(2, 12), elements=st.floats(-6, 6, allow_subnormal=False))


def patch_case(limits=None, **operators) -> jb.Case:
    patch = jb.Patch(0.2575, 0.3425, 0.15, limits=limits, **operators)
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, damping_ratio=0.03, modes=2),
        actuators=[patch],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=3.0)],
        controller=jb.Feedback([3000.0], period=0.004, delay=0.006),
        run=jb.Run(0.2, 250.0),
    )


def by_hand(commands):
    """Outputs of OPERATOR by play operators written out."""
    plays, found = [0.0] * 4, []
    for u in commands:
        for i, r in enumerate((0.0, 0.5, 1.5, 3.0)):
            if u - plays[i] > r:
                plays[i] = u - r
            elif plays[i] - u > r:
                plays[i] = u + r
        found.append(0.7 * plays[0] + 0.15 * plays[1] + 0.1 * plays[2] + 0.15 * plays[3])
    return found


@settings(deadline=None, max_examples=8)
@given(COMMANDS)
def test_properties_of_the_operator(commands):
    outputs = OPERATOR.outputs(commands)
    assert_allclose(outputs, by_hand(commands), atol=1e-12)
    # Rate independence: the same at whatever times, with points in between on the way.
    between = np.interp(np.arange(0, 3 * len(commands) - 2) / 3, np.arange(len(commands)), commands)
    assert_allclose(OPERATOR.outputs(between)[::3], outputs, atol=1e-12)
    # Wiping out: a loop within the range of the next command leaves no memory.
    low, high = sorted(commands[:2])
    loop = [low, high, (low + high) / 2, high, *commands]
    wiped = OPERATOR.outputs([low, high, *commands])[2:]
    assert_allclose(OPERATOR.outputs(loop)[4:], wiped, atol=1e-12)
    # The inverse undoes the operator, on either side.
    inverse = OPERATOR.inverse()
    assert_allclose(OPERATOR.outputs(inverse.outputs(commands)), commands, atol=1e-12)
    assert_allclose(inverse.outputs(outputs), commands, atol=1e-12)


def test_limits_are_those_of_the_commands_that_are_sent():
    """At the limits the law knows what acts, so that the inverse follows on leaving them."""
    record = jb.simulate(patch_case(limits=[-1.0, 2.0], hysteresis=OPERATOR, compensation=OPERATOR))
    command = np.asarray(record.command)
    assert command.max() == 2.0 and command.min() >= -1.0
    # 0.7 x 2 + 0.15 x 1.5 + 0.1 x 0.5, and 0.7 + 0.15 x 0.5 on the other side.
    assert_allclose(np.max(record.acting_command), 1.675, rtol=1e-12)
    low, high, _ = held_command_limits(record.case, 0.004)
    assert_allclose([low[0], high[0]], [-0.775, 1.675])


def test_commands_of_the_bound_act_where_the_hysteresis_is_compensated():
    case = patch_case(limits=[-1.0, 2.0], hysteresis=OPERATOR)
    least = jb.bound(case, period=0.04)
    replay = dataclasses.replace(with_exact_compensation(case), controller=least.controller())
    assert_allclose(jb.simulate(replay).peak_deflection.max(), least.peak, rtol=2e-3)


@pytest.mark.parametrize(
    ("operator", "message"),
    [
        (([0.0, 1.0], [0.5]), "actuators.0.hysteresis.weights must be as many as thresholds"),
        (([0.1, 1.0], [0.5, 0.5]), "actuators.0.hysteresis.thresholds must begin with 0"),
        (([0.0, 1.0], [0.5, -0.1]), "actuators.0.hysteresis.weights must not be negative"),
    ],
)
def test_errors_of_hysteresis_and_creep(operator, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(patch_case(hysteresis=jb.actuators.Hysteresis(*operator)))


def test_hysteresis_needs_samples():
    case = patch_case(hysteresis=OPERATOR)
    continuous = dataclasses.replace(case, controller=jb.Feedback([3000.0]))
    with pytest.raises(ValueError, match="the hysteresis of actuators.0 needs a controller that"):
        check_case(continuous)


def test_round_trip_of_a_record():
    record = jb.simulate(patch_case(hysteresis=OPERATOR))
    found = record_from_xarray(record.to_xarray())
    assert_allclose(found.acting_command, record.acting_command)
    assert found.case.actuators[0].hysteresis.weights[3] == 0.15


# Creep of actuators against its differential equations, its inverse, and loops with both.

CREEP = jb.actuators.Creep([20.0, 2.0, 0.2], [0.05, 0.04, 0.03])
CREEP_OTHER = jb.actuators.Creep([12.0, 1.0], [0.06, 0.05])
HELD = np.asarray(0.01)


def acting(operator, commands):
    """What acts for commands in turn, and the state at the end."""
    state, found = operator.start(1), []
    for command in commands:
        state = operator.follow(state, np.full(1, command))
        found.append(operator.output(state)[0])
    return np.array(found), state


def test_mean_over_each_period_is_that_of_the_equations():
    """z_i' = a_i (v - z_i) by scipy under held commands, behind the hysteresis."""
    commands = 3 * np.sin(0.9 * np.arange(12)) + 1
    at_once = OPERATOR.outputs(commands)
    state, means = np.zeros(6), []
    for held in at_once:

        def rates(t, y, held=held):
            return [*(CREEP.rates * (held - y[:3])), *y[:3]]

        state[3:] = 0
        found = solve_ivp(rates, (0, HELD), state, rtol=1e-11, atol=1e-13)
        state = found.y[:, -1]
        means.append(held + CREEP.weights @ state[3:] / HELD)
    found, _ = acting(command_operator(OPERATOR, CREEP, HELD), commands)
    assert_allclose(found, means, rtol=1e-8)


def test_step_response_rises_as_the_logarithm_of_time():
    """Equal weights a decade apart: as much in each decade, 0.02 a decade (within 8 %)."""
    creep = jb.actuators.Creep(10.0 ** np.arange(3.0, -4.0, -1), np.full(7, 0.02))
    times = np.array([0.1, 1.0, 10.0])
    final = 1 + 0.02 * np.sum(1 - np.exp(-creep.rates * times[:, None]), axis=1)
    found = [creep.outputs(np.ones(2), t)[1] for t in times]
    assert_allclose(found, final, rtol=1e-12)
    assert_allclose(np.diff(found), 0.02, rtol=0.08)
    assert_allclose(creep.final_gain, 1.14)


@pytest.mark.parametrize("hysteresis", [None, OPERATOR])
def test_inverse_undoes_the_operator(hysteresis):
    operator = command_operator(hysteresis, CREEP, np.asarray(0.3))
    wanted = np.random.default_rng(2).normal(size=25)
    commands, _ = acting(operator.inverse(), wanted)
    assert_allclose(acting(operator, commands)[0], wanted, atol=1e-12)
    assert np.max(np.abs(commands - wanted)) > 0.1


def test_compensated_loop_is_that_of_the_linear_patch_of_creep():
    linear = jb.simulate(patch_case())
    both = {"hysteresis": OPERATOR, "creep": CREEP}
    exact = with_exact_compensation(patch_case(**both))
    rough = patch_case(**both, compensation=OPERATOR, creep_compensation=CREEP_OTHER)
    runs = [jb.simulate(case) for case in (patch_case(**both), rough, exact)]
    size = np.max(np.abs(linear.deflection))
    errors = [np.max(np.abs(run.deflection - linear.deflection)) for run in runs]
    assert errors[0] > 0.02 * size and errors[1] < errors[0] / 2 and errors[2] < 1e-11 * size
    assert_allclose(runs[2].acting_command, linear.command, atol=1e-9)
    # What acts in the loop is what the operator makes of the commands that were sent.
    sent, acted = (np.asarray(part)[:, 0] for part in (runs[0].command, runs[0].acting_command))
    first = np.flatnonzero(sent)[0]
    operator = command_operator(OPERATOR, CREEP, patch_case().controller.period)
    assert_allclose(acted[first:], acting(operator, sent[first:])[0], atol=1e-12)


def test_sensors_between_commands_do_not_hasten_the_creep():
    """Events of a sensor that samples more often than the law leave the creep as it is."""
    case = patch_case(creep=CREEP)
    quick = jb.Sensor(0.2, sampling_period=0.001)
    often = dataclasses.replace(case, sensors=(*case.sensors, quick))
    assert_allclose(jb.simulate(often).acting_command, jb.simulate(case).acting_command, atol=1e-9)


def test_range_of_what_acts_holds_under_any_command():
    case = patch_case(limits=[-1.0, 2.0], hysteresis=OPERATOR, creep=CREEP)
    low, high, _ = acting_ranges(case)
    assert_allclose([low[0], high[0]], [-0.775 * 1.12, 1.675 * 1.12])
    operator = command_operator(OPERATOR, CREEP, np.asarray(2.0))
    assert_allclose(acting(operator, np.full(30, 2.0))[0][-1], 1.675 * 1.12, rtol=1e-4)


@pytest.mark.parametrize(
    ("creep", "message"),
    [
        (
            jb.actuators.Creep([1.0, 2.0], [0.5]),
            "actuators.0.creep.weights must be as many as rates",
        ),
        (
            jb.actuators.Creep([0.0], [0.5]),
            "actuators.0.creep.rates.0 must be positive; it is 0 1/s",
        ),
        (jb.actuators.Creep([1.0], [-0.5]), "actuators.0.creep.weights.0 must not be negative"),
    ],
)
def test_errors_of_creep(creep, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(patch_case(creep=creep))


def test_creep_needs_samples():
    case = dataclasses.replace(patch_case(creep=CREEP), controller=jb.Feedback([3000.0]))
    with pytest.raises(ValueError, match="the creep of actuators.0 needs a controller that"):
        check_case(case)
