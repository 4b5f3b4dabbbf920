"""Identification of actuators from logs of commands: true values are recovered."""

import dataclasses

import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
import tuning
from tests.case.test_actuators import OPERATOR, by_hand
from tuning import Log, identify, read_log
from tuning.fit.hysteresis import fitted_hysteresis

LENGTH, RIGIDITY, DENSITY, DAMPING, MODES = 0.6, 11.68, 0.535, 0.03, 3
SHAKER = {"position": 0.5, "stiffness": 3500.0, "damping": 80.0, "force_per_volt": 4.6}
BANDWIDTH = 1e4
PATCH = {"start": 0.2575, "end": 0.3425, "moment_per_volt": 8.292e-4, "correction": 0.32}
GAIN = 200.0
POSITIONS = (0.15, 0.3)


def shapes(x, derivative=0):
    """Mass-normalised sine modes of the pinned beam, or their slopes."""
    waves = np.arange(1, MODES + 1) * np.pi / LENGTH
    curve = np.sin(waves * x) if derivative == 0 else waves * np.cos(waves * x)
    return np.sqrt(2 / (DENSITY * LENGTH)) * curve


def respond(times, shaker_volts, patch_volts):
    """Deflections (m) at the positions, by scipy's exact response to linear inputs."""
    frequencies = (np.arange(1, MODES + 1) * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / DENSITY)
    shape = shapes(SHAKER["position"])
    stiffness = np.diag(frequencies**2) + SHAKER["stiffness"] * np.outer(shape, shape)
    damping = np.diag(2 * DAMPING * frequencies) + SHAKER["damping"] * np.outer(shape, shape)
    modal_moment = shapes(PATCH["start"], 1) - shapes(PATCH["end"], 1)
    modal_moment = modal_moment * PATCH["moment_per_volt"] * PATCH["correction"] * GAIN
    n = MODES
    A = np.zeros((2 * n + 1, 2 * n + 1))
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n] = np.hstack([-stiffness, -damping, SHAKER["force_per_volt"] * shape[:, None]])
    A[2 * n, 2 * n] = -BANDWIDTH
    B = np.zeros((2 * n + 1, 2))
    B[2 * n, 0], B[n : 2 * n, 1] = BANDWIDTH, modal_moment
    C = np.hstack([[shapes(x) for x in POSITIONS], np.zeros((2, n + 1))])
    inputs = np.column_stack([shaker_volts, patch_volts])
    return scipy.signal.lsim((A, B, C, np.zeros((2, 2))), inputs, times)[1]


def case(**shaker):
    """The rig, with wrong values of the shaker where given."""
    return jb.Case(
        jb.Beam(
            length=LENGTH,
            flexural_rigidity=RIGIDITY,
            mass_per_length=DENSITY,
            damping_ratio=DAMPING,
            modes=MODES,
        ),
        actuators=[
            jb.Shaker(**{**SHAKER, **shaker}, bandwidth=BANDWIDTH),
            jb.Patch(**{**PATCH, "correction": 0.5}, amplifier_gain=GAIN),
        ],
        sensors=[jb.Sensor(x) for x in POSITIONS],
    )


TIMES = np.arange(1001) / 1000.0
SWEPT = scipy.signal.chirp(TIMES, 2.0, 1.0, 60.0)
STEPS = 2.0 * np.sign(np.sin(2 * np.pi * 3.1 * TIMES))


def log(shaker_volts, patch_volts, noise=2e-7, seed=0, **about):
    """Readings with white noise (m) and the two commands, as a log."""
    readings = respond(TIMES, shaker_volts, patch_volts)
    readings = readings + noise * np.random.default_rng(seed).normal(size=readings.shape)
    values = np.column_stack([readings, shaker_volts, patch_volts])
    return Log(
        TIMES,
        values,
        ("d1", "d2", "u", "v"),
        ("deflection", "deflection", "voltage", "voltage"),
        ("m", "m", "V", "V"),
        actuators=(None, None, 0, 1),
        **about,
    )


def test_shaker_and_patch_together():
    free = [
        "actuators.0.force_per_volt",
        "actuators.0.stiffness",
        "actuators.0.damping",
        "actuators.1.correction",
    ]
    start = case(force_per_volt=3.8, stiffness=4300.0, damping=60.0)
    logs = [log(2.0 * SWEPT, 0 * SWEPT), log(SWEPT, STEPS, seed=1)]
    fit = identify(start, logs, free)
    truth = np.array([4.6, 3500.0, 80.0, 0.32])
    np.testing.assert_allclose(fit.values, truth, rtol=0.02)
    assert np.all(np.abs(fit.values - truth) < 4 * fit.errors)
    assert fit.search == "converged" and not fit.unidentifiable
    np.testing.assert_allclose(fit.noise, 2e-7, rtol=0.1)


def test_a_patch_alone_from_a_file(tmp_path):
    steps = log(0 * SWEPT, STEPS)
    table = np.column_stack([steps.times, steps.values[:, [0, 1, 3]]])
    path = tmp_path / "steps.csv"
    np.savetxt(path, table, delimiter=",", header="t [s],d1 [m],d2 [m],v [V]", comments="")
    path.with_suffix(".toml").write_text(
        "[columns]\nd1 = { sensor = 0 }\nd2 = { sensor = 1 }\nv = { actuator = 1 }\n"
    )
    fit = identify(case(), read_log(path), {"actuators.1.correction": (0.05, 1.0)})
    assert fit.values[0] == pytest.approx(0.32, rel=5e-3)
    assert fit.case.controller is None
    assert fit.cases[0].controller.values.shape == (2, 1001)


SPRING = 3500.0, 6.0  # N/m, N s/m


def spring_beside_a_patch(period: int) -> Log:
    """Log of both, exactly, under steps of a converter every `period` samples."""
    stiffness, damping = SPRING
    frequencies = (np.arange(1, MODES + 1) * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / DENSITY)
    at, n = shapes(0.5), MODES
    moment = (shapes(PATCH["start"], 1) - shapes(PATCH["end"], 1)) * GAIN
    moment = moment * PATCH["moment_per_volt"] * PATCH["correction"]
    A = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [
                -np.diag(frequencies**2) - stiffness * np.outer(at, at),
                -np.diag(2 * DAMPING * frequencies) - damping * np.outer(at, at),
            ],
        ]
    )
    B = np.append(np.zeros(n), moment)[:, None]
    C = np.hstack([[shapes(x) for x in POSITIONS], np.zeros((2, n))])
    walk = np.cumsum(np.random.default_rng(3).normal(size=1002 // period))
    levels = np.clip(0.4 * (walk - np.linspace(0.0, walk[-1], walk.size)), -2.4, 7.4)
    volts = np.repeat(levels, period)[:1001]
    exact = scipy.signal.cont2discrete((A, B, C, np.zeros((2, 1))), 1e-3, "zoh")[:4]
    readings = scipy.signal.dlsim((*exact, 1e-3), volts)[1]
    readings = readings + 2e-7 * np.random.default_rng(4).normal(size=readings.shape)
    table = np.column_stack([readings, volts])
    return Log(
        TIMES,
        table,
        ("d1", "d2", "v"),
        ("deflection", "deflection", "voltage"),
        ("m", "m", "V"),
        actuators=(None, None, 0),
    )


def fit_of_spring_and_patch(log: Log, free=(), **changes):
    """Fit of a spring's numbers and the patch's, and of others, by readings with `changes`."""
    rig = case()
    spring = jb.SpringDamper(0.5, stiffness=4300.0, damping=9.0)
    sensors = tuple(dataclasses.replace(sensor, **changes) for sensor in rig.sensors)
    rig = dataclasses.replace(rig, actuators=(rig.actuators[1], spring), sensors=sensors)
    addresses = ["actuators.0.correction", "actuators.1.stiffness", "actuators.1.damping", *free]
    fit = identify(rig, [log], addresses)
    deviations = np.abs(fit.values[:3] - [PATCH["correction"], *SPRING]) / fit.errors[:3]
    return fit, deviations


def test_a_spring_beside_a_patch_whose_commands_are_held():
    """Steps every 2 ms: read as ramps they are damping less by k dt / 2."""
    fit, deviations = fit_of_spring_and_patch(spring_beside_a_patch(2))
    assert np.all(deviations < 4)
    assert fit.errors[2] < 0.01  # of a bias of 1.75 N s/m


def test_commands_that_are_logged_once_a_period_are_seen_by_delays():
    """They cannot be told from others that change between samples, but are half a sample late."""
    log = spring_beside_a_patch(1)
    fit, deviations = fit_of_spring_and_patch(log)
    assert np.max(deviations) > 4
    assert fit.verdict.startswith("the model misses something")
    assert "late" in str(fit) and "under commands held from sample to sample" in str(fit)
    delays = "sensors.0.delay", "sensors.1.delay"
    fit, deviations = fit_of_spring_and_patch(log, delays, delay=2e-4)
    assert np.all(deviations < 4)
    np.testing.assert_allclose(fit.values[3:], 0.5e-3, rtol=0.02)


def loop_readings(gain, period, step, speed, weight):
    """Times, deflection and held commands of a force on a beam under feedback; steps are exact."""
    frequencies = (np.arange(1, MODES + 1) * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / DENSITY)
    zero, n = np.zeros((MODES, MODES)), MODES
    # The force is a sine of each mode: oscillators of their own, cut off as it leaves.
    turning = np.diag(np.arange(1, n + 1) * np.pi * speed / LENGTH)
    size = weight * np.sqrt(2 / (DENSITY * LENGTH)) * np.eye(n)
    stiff, damped = -np.diag(frequencies**2), -np.diag(2 * DAMPING * frequencies)
    A = np.block(
        [
            [zero, np.eye(n), zero, zero],
            [stiff, damped, size, zero],
            [zero, zero, zero, turning],
            [zero, zero, -turning, zero],
        ]
    )
    B = np.concatenate([np.zeros(n), shapes(0.5), np.zeros(2 * n)])[:, None]
    A, B = scipy.signal.cont2discrete((A, B, A[:1], [[0.0]]), step, "zoh")[:2]
    count = round(LENGTH / speed / step) + 1
    state = np.concatenate([np.zeros(3 * n), np.ones(n)])
    reading, readings, commands = np.append(shapes(0.3), np.zeros(3 * n)), [], []
    for i in range(count):
        readings.append(reading @ state)
        commands.append(-gain * readings[-1] if i % period == 0 else commands[-1])
        state = A @ state + B[:, 0] * commands[-1]
    return step * np.arange(count), -np.array(readings)[:, None], -np.array(commands)[:, None]


def test_readings_between_the_samples_of_a_loop():
    """A force on a beam under feedback held for 4 ms, logged every ms."""
    gain, period, step, speed, weight = 400.0, 4, 1e-3, 1.0, 3.0
    times, readings, _ = loop_readings(gain, period, step, speed, weight)
    noise = 2e-7 * np.random.default_rng(5).normal(size=readings.shape)
    log = Log(times, readings + noise, ("w",), ("deflection",), ("m",), sensors=(0,))
    loop = jb.Case(
        jb.Beam(LENGTH, RIGIDITY, DENSITY, damping_ratio=DAMPING, modes=MODES),
        actuators=[jb.PointForce(0.5)],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingForce(force=weight, speed=speed)],
        controller=jb.Feedback([300.0], period=period * step),
    )
    start = jb.replace(loop, {"beam.flexural_rigidity": 0.9 * RIGIDITY})
    free = ["beam.flexural_rigidity", "controller.gains.0"]
    fit = identify(start, [log], free)
    assert "set sensors.N.sampling_period to 0.001 s" in str(fit)
    sensors = (jb.Sensor(0.3, sampling_period=step),)
    fit = identify(dataclasses.replace(start, sensors=sensors), [log], free)
    assert np.all(np.abs(fit.values - [RIGIDITY, gain]) < 4 * fit.errors)
    assert fit.verdict.startswith("the model explains the logs")
    assert "sampling_period" not in str(fit)


def test_a_feedback_that_is_logged_as_the_command_is_told():
    """The signal before it is sampled and held is no command; with what is held fits are right."""
    gain, period, speed, weight = 400.0, 10, 1.0, 3.0
    times, readings, commands = loop_readings(gain, period, 1e-3, speed, weight)
    readings = readings + 2e-7 * np.random.default_rng(5).normal(size=readings.shape)
    beam = jb.Beam(LENGTH, 0.95 * RIGIDITY, DENSITY, damping_ratio=DAMPING, modes=MODES)
    loads = [jb.MovingForce(force=weight, speed=speed)]
    start = jb.Case(beam, actuators=[jb.PointForce(0.5)], sensors=[jb.Sensor(0.3)], loads=loads)
    kinds = ("w", "u"), ("deflection", "force"), ("m", "N")

    def fit_of(channel):
        values = np.concatenate([readings, channel], axis=1)
        log = Log(times, values, *kinds, sensors=(0, None), actuators=(None, 0))
        return identify(start, [log], ["beam.flexural_rigidity"])

    right, wrong = fit_of(commands), fit_of(-gain * readings)
    assert abs(right.values[0] - RIGIDITY) < 4 * right.errors[0] < 1e-4 * RIGIDITY
    assert right.verdict.startswith("the model explains the logs")
    assert wrong.verdict.startswith("the model misses something")


def test_faulty_commands_are_refused():
    good = log(SWEPT, STEPS)

    def refused(message, rig=None, **changes):
        with pytest.raises(ValueError, match=message):
            identify(rig or case(), dataclasses.replace(good, **changes), "actuators.0.stiffness")

    refused("u is the command to actuators.2, but the case has 2", actuators=(None, None, 2, 1))
    refused("two of its channels are commands to actuators.0", actuators=(None, None, 0, 0))
    refused(
        "u holds force in V, but the command to actuators.0 is in V",
        quantities=("deflection", "deflection", "force", "voltage"),
    )
    refused(
        "v goes from -4 to 4 V, beyond what actuators.1 takes, -2.5 to 7.5 V",
        values=good.values * [1.0, 1.0, 1.0, 2.0],
    )
    driven = dataclasses.replace(case(), controller=jb.Prescribed(offsets=[0.0, 0.0]))
    refused("its commands and the controller of the case contradict each other", driven)


# Hysteresis identified from logs of planted play operators.

TURNS = np.array([0.0, 2.0, -1.0, 4.0, -3.0, 5.0, 0.0])
COMMANDS = np.interp(np.linspace(0, 6, 121), np.arange(7), TURNS)
FORCE_GAIN, OFFSET = -2e-5, 1e-4


def log_of(readings, commands=COMMANDS):
    values = np.stack([commands, readings], axis=1)
    names, kinds, units = ("u", "w"), ("voltage", "deflection"), ("V", "m")
    return tuning.Log(0.1 * np.arange(len(commands)), values, names, kinds, units)


def test_planted_operator_is_found():
    """Scaled so that the first excursion to 5 V reaches 5 V."""
    outputs = np.array(by_hand(COMMANDS))
    found = fitted_hysteresis(
        log_of(OFFSET + FORCE_GAIN * outputs), "u", "w", np.array([0.0, 0.5, 1.5, 3.0])
    )
    scale = (0.7 * 5 + 0.15 * 4.5 + 0.1 * 3.5 + 0.15 * 2) / 5
    assert_allclose(found.hysteresis.weights, np.array(OPERATOR.weights) / scale, rtol=1e-9)
    assert_allclose([found.gain, found.offset], [FORCE_GAIN * scale, OFFSET], rtol=1e-9)
    assert_allclose(found.hysteresis.first_output(np.asarray(5.0)), 5.0)


def test_other_thresholds_and_noise():
    """With the thresholds not known and noise of 1 % of the stroke, its inverse leaves little."""
    outputs = np.array(by_hand(COMMANDS))
    noise = 1e-6 * np.random.default_rng(1).normal(size=len(COMMANDS))
    found = fitted_hysteresis(log_of(FORCE_GAIN * outputs + noise), "u", "w")
    assert found.residual < 1.1e-6 < found.linear_residual / 4
    wanted = 3 * np.sin(np.linspace(0, 9, 200))
    acting = OPERATOR.outputs(found.hysteresis.inverse().outputs(wanted)) * FORCE_GAIN / found.gain
    assert np.std(acting - wanted) < np.std(OPERATOR.outputs(wanted) - wanted) / 4


@pytest.mark.parametrize(
    ("arguments", "commands", "message"),
    [
        (("x", "w"), COMMANDS, "the log has no channel 'x'; it has u, w"),
        (("u", "w"), np.ones(121), "commands 'u' are constant"),
        (("u", "w", np.array([0.1])), COMMANDS, "thresholds must begin with 0"),
    ],
)
def test_errors(arguments, commands, message):
    with pytest.raises(ValueError, match=message):
        fitted_hysteresis(log_of(COMMANDS, commands), *arguments)
