"""Closed loops against an independent one, reference numbers, and their events in C.

Plans are given: each test compiles a loop of its own, and trial runs would compile more.
"""

import dataclasses
import json
import re
import struct
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensor_signals import noise_samples
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.c_writer import UntranslatedError
from jaxbeam.runtime.native_library import C_FOLDER, find_compiler
from jaxbeam.simulation.closed_loop import closed_loop, loop_schedule
from jaxbeam.simulation.integration_plan import (
    IntegrationPlan,
    integration_plan,
    sample_times,
    static_shapes,
)
from jaxbeam.simulation.integrator.inputs import HeldCommands, StepInfo
from jaxbeam.simulation.simulate import run_integration, simulate_readings
from jaxbeam.simulation.sweeps.native_integration import translated_loops
from tests.export.cases import CASES
from tests.loop_as_oracle import expected
from tests.modules import DATA

TIMES = np.linspace(0.0, 0.4, 81)
BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3)
MASS = jb.MovingMass(mass=0.4, speed=2.0)  # leaves at 0.3 s
SHAKER = jb.Shaker(0.5, stiffness=3500.0, damping=8.0, force_per_volt=4.6, bandwidth=400.0)
PATCH = jb.Patch(0.2575, 0.3425, 8.3e-4, correction=0.32, amplifier_gain=200.0)
SENSOR = jb.Sensor(0.25)


def loop(actuators, sensors, controller, beam=BEAM, loads=(MASS,), duration=0.4) -> jb.Case:
    return jb.Case(beam, (), actuators, sensors, loads, controller, jb.Run(duration))


def plan_with_substeps(case: jb.Case, times, substeps: int) -> IntegrationPlan:
    """Plan with a number of steps between events, without trial runs."""
    return IntegrationPlan(
        static_shapes(case), substeps, 0, False, 0.0, loop_schedule(case, np.asarray(times))
    )


def run(case: jb.Case, times=TIMES, substeps: int = 2) -> jb.Record:
    return jb.simulate(case, jnp.asarray(times), plan_with_substeps(case, times, substeps))


ALL_STATES = [[300.0, 10.0, 20.0, 2.0, 0.1, -0.1, 0.02]]
SIGNALS = {
    "offsets": [0.1, 0.2],
    "amplitudes": [[0.3, 0.1], [0.4, 0.0]],
    "frequencies": [7.0, 23.0],
    "phases": [[0.0, 1.0], [2.0, 0.0]],
    "times": [0.0123, 0.1, 0.2347],  # between samples; a jump at the last one
    "values": [[1.0, 2.0, -1.0], [0.0, 3.0, 1.0]],
}
LOOPS = {
    "state feedback at samples, delay within a period": loop(
        [SHAKER], [SENSOR], jb.StateFeedback(ALL_STATES, period=1e-3, delay=4e-4)
    ),
    "delay beyond two periods, filter at the sensor's own period": loop(
        [SHAKER],
        [jb.Sensor(0.25, sampling_period=0.0033, filter=jb.Filter(50.0, 2))],
        jb.Feedback([300.0], period=0.0021, delay=0.0048),
    ),
    "two actuators, two sensors": loop(
        [SHAKER, PATCH],
        [
            jb.Sensor(
                0.25, offset=1e-4, filter=jb.Filter(60.0, 3), sampling_period=1e-3, delay=0.0013
            ),
            jb.Sensor(0.3, "velocity", delay=0.003, resolution=1e-3, range=[-0.01, 0.02]),
        ],
        jb.Feedback([200.0, 0.3], period=2e-3, delay=5e-4),
    ),
    "saturation and quantisation": loop(
        [dataclasses.replace(SHAKER, limits=jnp.array([-0.3, 0.4]))],
        [SENSOR],
        jb.Feedback([500.0], period=2e-3, resolution=0.01),
    ),
    "rate limit": loop(
        [dataclasses.replace(PATCH, rate_limit=jnp.array(3.0))],
        [SENSOR],
        jb.Feedback([500.0], period=2e-3, delay=1e-3),
    ),
    "acceleration through a digital filter": loop(
        [PATCH],
        [jb.Sensor(0.25, "acceleration", filter=jb.Filter(80.0, 2), delay=7e-4)],
        jb.Feedback([0.005], period=2e-3),
    ),
    "strain through an analogue filter, sampled": loop(
        [PATCH],
        [
            jb.Sensor(
                0.25,
                "strain",
                fibre_distance=1.65e-3,
                filter=jb.Filter(20.0, 4, realisation="analogue"),
                delay=1e-3,
            )
        ],
        jb.Feedback([5e3], period=2e-3),
    ),
    "prescribed in continuous time": loop([SHAKER, PATCH], [SENSOR], jb.Prescribed(**SIGNALS)),
    "prescribed at samples": loop(
        [SHAKER, PATCH], [SENSOR], jb.Prescribed(**SIGNALS, period=5e-3, delay=1e-3)
    ),
    "linear law in continuous time": loop([SHAKER], [SENSOR], jb.StateFeedback(ALL_STATES)),
    "cubic law in continuous time": loop([PATCH], [SENSOR], jb.Feedback([2e8], power=3)),
    "linear, cubic and quintic, two loops that are not collocated": loop(
        [SHAKER, PATCH],
        [jb.Sensor(0.15), jb.Sensor(0.45)],
        jb.Feedback([100.0, 500.0], higher_gains=[[0.0, 1e8], [5e13, 3e13]], period=2e-3),
    ),
    "law through an analogue filter": loop(
        [PATCH],
        [jb.Sensor(0.25, filter=jb.Filter(20.0, 4, realisation="analogue"))],
        jb.Feedback([1000.0]),
    ),
    "strong damping in continuous time": loop(
        [jb.PointForce(0.3)], [jb.Sensor(0.3, "velocity")], jb.Feedback([200.0])
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_agree_with_the_oracle(name):
    case = LOOPS[name]
    record = run(case, substeps=4 if case.controller.period is None else 2)
    truth = expected(case, TIMES)
    pairs = [(record.deflection, truth.deflection), (record.command, truth.command)]
    if case.controller.period is not None:
        pairs.append((record.measured, truth.arrived_readings))
    for found, true in pairs:
        size = np.max(np.abs(true), axis=0)
        assert np.all(size > 0)
        assert np.all(np.abs(found - true) <= 1e-9 * size)


def test_controller_and_record_have_the_same_noise():
    """One sample of noise per reading; without loads it is the only excitation."""
    sensor = jb.Sensor(0.25, noise=1e-4, sampling_period=4e-3)
    case = loop([PATCH], [sensor], jb.Feedback([1000.0], period=2e-3), loads=())
    record = run(case, 2e-3 * np.arange(101))
    noise = 1e-4 * np.asarray(noise_samples(case.run.seed, 1, 101))[np.arange(101) // 2]
    readings = record.deflection[::2] + noise[::2]
    assert_allclose(record.measured, np.repeat(readings, 2, axis=0)[:101], rtol=1e-12)
    # The last command, too, is the one just after the sample.
    assert_allclose(record.command, -1000.0 * record.measured, rtol=1e-12)


@pytest.mark.parametrize("quantity", ["deflection", "strain"])
def test_first_trial_run_is_the_run_by_its_plan(quantity):
    """Steps end at sensors of strain, too, in the trial run whose record is the result."""
    fibre = 1e-3 if quantity == "strain" else None
    sensor = jb.Sensor(0.33, quantity, fibre_distance=fibre)
    case = loop([PATCH], [sensor], jb.Feedback([500.0], period=0.01))
    record, plan = jb.simulate(case, TIMES), integration_plan(case, TIMES)
    again = jb.simulate(case, TIMES, plan)
    assert record.steps == again.steps and 0 < record.error_estimate < 1e-7
    for ours, theirs in zip(record.extremes, again.extremes, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(record.deflection, again.deflection)
    np.testing.assert_array_equal(record.command, again.command)


def test_run_under_its_own_commands_is_the_same_run(monkeypatch):
    """So the law is asked once a sample, and not again to find the error of the steps."""
    controller = jb.Feedback([500.0], period=2e-3, delay=1e-3)
    case, asked = loop([PATCH], [SENSOR], controller, duration=0.2), []
    times, law = TIMES[:41], type(controller.law(state_space(case)))
    step = law.step
    monkeypatch.setattr(law, "step", lambda *args: asked.append(0) or step(*args))
    record = jb.simulate(case, times)
    assert len(asked) == 101 and record.error_estimate < 1e-8
    fine = jb.simulate(case, times, plan_with_substeps(case, times, 4)).deflection
    change = np.max(np.abs(record.deflection - fine)) / np.max(np.abs(fine))
    assert change < record.error_estimate
    asked.clear()
    plan, layout = plan_with_substeps(case, times, 2), mesh_layout(case)
    policy = closed_loop(case, layout, load_set(case, layout), plan.schedule)
    closed = run_integration(case, plan, times, None, policy=policy)
    events = closed.grid.event_at(np.arange(closed.steps)) >= 0
    held = HeldCommands(policy.model, closed.commands[events], policy.load_amplitude)
    found = run_integration(case, plan, times, None, policy=held)
    assert len(asked) == 101 and events.sum() > 200
    assert_allclose(found.states, closed.states, rtol=0, atol=1e-14)


def test_readings_for_fits_have_no_noise():
    """Filters run at the samples of the loop, not at the sample times of the run."""
    noiseless = LOOPS["delay beyond two periods, filter at the sensor's own period"]
    noisy = dataclasses.replace(noiseless.sensors[0], noise=jnp.array(1e-3))
    case = dataclasses.replace(noiseless, sensors=(noisy,))
    plan = plan_with_substeps(case, TIMES, 2)
    found = jax.jit(lambda: simulate_readings(case, jnp.asarray(TIMES), plan))()
    truth = expected(noiseless, TIMES).arrived_readings
    assert_allclose(found, truth, rtol=0, atol=1e-9 * np.max(np.abs(truth)))


@pytest.mark.parametrize(
    ("actuator", "gain"),
    [
        (dataclasses.replace(SHAKER, limits=jnp.array([-0.3, 0.4])), 500.0),
        (jb.PointForce(0.25, limits=[-1.0, 1.0]), 20000.0),
    ],
)
def test_law_that_saturates_within_a_step_meets_the_tolerance(actuator, gain):
    """At the kink of the command the order falls to about two, which peaks do not show."""
    case = loop([actuator], [SENSOR], jb.Feedback([gain]))
    record = jb.simulate(case, jnp.asarray(TIMES), tolerance=1e-7)
    truth = expected(case, TIMES)
    error = np.max(np.abs(record.deflection - truth.deflection)) / np.max(np.abs(truth.deflection))
    assert error <= 1e-7 and record.error_estimate <= 1e-7
    assert record.steps > 8 * TIMES.size
    assert np.max(record.command) == actuator.limits[1]
    assert 0 < np.sum(record.saturated) < TIMES.size


def test_a_loop_without_sensors_and_loads():
    """A steady force for 2 s: the deflection that statics has, by modes 1 to 3, and no peaks."""
    beam = jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.3, modes=3)
    law = jb.Prescribed(offsets=[2.0], period=0.01)
    case = jb.Case(beam, actuators=[jb.PointForce(0.3)], controller=law, run=jb.Run(2.0, 50.0))
    record = jb.simulate(case)
    expected = 2.0 * 2 * 0.6**3 / (np.pi**4 * 12.0) * (1 + 1 / 3**4)
    assert_allclose(record.at(0.3)[-1], expected, rtol=1e-9)
    assert record.peak_deflection.shape == (0,)


# Closed loops against numbers of the reference implementation.

REFERENCE = json.loads((DATA / "reference_control.json").read_text())


def reference_case(name: str) -> jb.Case:
    """Rig A under its time-invariant gain; rig B under constant voltage or feedback."""
    reference = REFERENCE[name]
    if name == "time-invariant gain":
        beam = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3)
        shaker = jb.Shaker(0.5, stiffness=12000.0, damping=80.0, force_per_volt=2.5, bandwidth=1e4)
        # The gain is for amplitudes of sines, the states are mass-normalised.
        scale = np.full(6, np.sqrt(2 / (0.535 * 0.6)))
        gain = np.array(reference["gain"]) * np.array(reference["used"]) * np.append(scale, 1.0)
        law, sensor, duration = jb.StateFeedback(gain[None]), jb.Sensor(0.25), 1.5
        return loop([shaker], [sensor], law, beam, [jb.MovingMass(0.509, 0.55)], duration)
    beam = jb.Beam(0.6, 13.211, 0.812, 0.03, modes=5)
    patch = jb.Patch(0.2575, 0.3425, reference["moment_per_volt"], amplifier_gain=200.0)
    filter = None
    if name == "constant voltage":
        law = jb.Prescribed([7.5])
    elif name == "linear law":
        law = jb.Feedback([2e3])
    else:
        law, filter = jb.Feedback([2e9], 3), jb.Filter(10.0, 10, realisation="analogue")
    load = jb.MovingMass(reference["mass"], reference["speed"])
    return loop([patch], [jb.Sensor(0.3, filter=filter)], law, beam, [load], 1.21)


@pytest.mark.parametrize("name", REFERENCE)
def test_reference_numbers(name):
    reference = REFERENCE[name]
    times = np.append(0.0, reference["time_s"])
    if "sampled_every_s" in reference:
        times = reference["sampled_every_s"] * np.arange(501)
    record = run(reference_case(name), times, reference["substeps"])
    at = np.searchsorted(times, np.array(reference["time_s"]) - 1e-9)
    for found, true in (
        (record.deflection[at, 0], reference["deflection_m"]),
        (record.command[at, 0], reference["command"]),
    ):
        assert_allclose(found, true, rtol=0, atol=1e-8 * np.max(np.abs(true)))
    if "sampled_every_s" in reference:
        largest = np.max(np.abs(record.deflection))
        assert_allclose(largest, reference["largest_sampled_deflection_m"], rtol=1e-8)
    else:
        assert_allclose(record.peak_deflection[0], reference["largest_deflection_m"], rtol=1e-8)


needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")

SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
EVENTS = 40
REFUSED = {"kalman-extended": "accelerations"}


def loop_of(case):
    """Sampled loop of a case."""
    schedule = loop_schedule(case, np.asarray(sample_times(case)), float(case.run.duration))
    layout = mesh_layout(case)
    return closed_loop(case, layout, load_set(case, layout), schedule)


def commands_in_c(translated, times, states, actuators, folder) -> np.ndarray:
    """Commands (event, actuator, run) under states, and of a loop whose readings stay at rest."""
    (folder / "program.c").write_text(translated.text)
    harness = Path(__file__).parents[1] / "native_loops.c"
    command = [find_compiler(), "-O0", "-Wall", "-Wno-unused", *SANITIZED, f"-I{C_FOLDER}"]
    files = [folder / "program.c", harness, "-o", folder / "program", "-lm"]
    subprocess.run([*command, *files], check=True)
    numbers = [struct.pack("q", len(translated.inputs))]
    for array in translated.inputs:
        numbers += [struct.pack("q", array.size), array.tobytes()]
    numbers += [struct.pack("q", translated.memory.size), translated.memory.tobytes()]
    numbers += [struct.pack("3q", len(times), states.shape[1], actuators)]
    for time, state in zip(times, states, strict=True):
        numbers += [struct.pack("d", time), state.tobytes()]
    (folder / "numbers").write_bytes(b"".join(numbers))
    run = [folder / "program", folder / "numbers"]
    ended = subprocess.run(run, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]
    return np.array(ended.stdout.split(), float).reshape(len(times), actuators, 2)


@needs_compiler
@pytest.mark.parametrize("kind", [kind for kind in CASES if kind not in REFUSED])
def test_events_give_the_commands_of_the_loop(kind, tmp_path):
    loop = loop_of(CASES[kind])
    times = np.asarray(loop.schedule.times)[:EVENTS]
    rng, count = np.random.default_rng(4), loop.model.state_count
    states = 1e-4 * np.cumsum(rng.normal(size=(times.size, count)), axis=0)
    memory, expected = loop.start(2), []
    for event, (time, state) in enumerate(zip(times, states, strict=True)):
        both = np.stack([state, np.zeros(count)], axis=1)
        info = StepInfo(np.float64(time), np.float64(0), np.int64(event))
        memory = loop._process_event(memory, both, info)
        expected.append(np.asarray(loop.path.acting(memory.commands)))
    actuators = len(CASES[kind].actuators)
    found = commands_in_c(translated_loops([loop])[0], times, states, actuators, tmp_path)
    largest = np.max(np.abs(expected))
    assert_allclose(found, expected, rtol=0, atol=1e-12 * largest)


@needs_compiler
@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_translated_is_named(kind):
    with pytest.raises(UntranslatedError, match=REFUSED[kind]):
        translated_loops([loop_of(CASES[kind])])


@needs_compiler
def test_loops_of_one_structure_share_their_code():
    """Numbers of the design, of the plant and of the schedule are arguments."""
    case, loops = CASES["pd"], [loop_of(CASES["mpc"])]
    for gain in (1.0, 2.0):
        controller = dataclasses.replace(case.controller, gains=gain * case.controller.gains)
        loops.append(loop_of(dataclasses.replace(case, controller=controller)))
    sensors = case.sensors[:2]  # as many numbers, of other parts
    for fine in (0, 1):
        one = [
            dataclasses.replace(s, resolution=1e-5 if i == fine else None)
            for i, s in enumerate(sensors)
        ]
        loops.append(loop_of(dataclasses.replace(case, sensors=one)))
    together, alone = translated_loops(loops), [translated_loops([loop])[0] for loop in loops]
    assert len({one.text for one in together}) == 4
    for one, other in zip(together, alone, strict=True):
        assert one.text == other.text
        assert_array_equal(one.memory, other.memory)
        for number, other_number in zip(one.inputs, other.inputs, strict=True):
            assert_array_equal(number, other_number)
    assert any(np.any(a != b) for a, b in zip(together[1].inputs, together[2].inputs, strict=True))


# Readings and commands that are lost or late at random, against the independent closed loop.

PERIOD = 5e-3
SPAN = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2)


def lossy_loop(sensors, run=None, **controller):
    """Two shakers, fed back from two sensors, under a mass."""
    settings = {"dropout": 0.25, "jitter": 2e-3, "period": PERIOD} | controller
    return jb.Case(
        SPAN,
        actuators=[jb.Shaker(0.2, 500.0, 5.0, limits=(-4.0, 4.0)), jb.PointForce(0.45)],
        sensors=sensors,
        loads=[jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02)],
        controller=jb.Feedback([400.0, 200.0], **settings),
        run=run or jb.Run(0.25, 400.0, seed=3),
    )


@pytest.mark.parametrize(
    ("sensors", "controller"),
    [
        ([jb.Sensor(0.2, dropout=0.3), jb.Sensor(0.4, jitter=3e-3)], {}),
        (
            [
                jb.Sensor(0.2, filter=jb.Filter(40.0, 3), dropout=0.4, offset=1e-4),
                jb.Sensor(0.4, delay=7e-3, jitter=12e-3, dropout=0.2),
            ],
            {"delay": 2e-3, "jitter": 11e-3},  # commands overtake each other
        ),
        (
            [
                jb.Sensor(0.2, filter=jb.Filter(30.0), sampling_period=3e-3, dropout=0.3),
                jb.Sensor(0.4, sampling_period=2 * PERIOD, jitter=1e-3, dropout=0.5),
            ],
            {"delay": PERIOD, "jitter": None},
        ),
    ],
)
def test_readings_and_commands_are_those_of_the_oracle(sensors, controller):
    """Of an event list with scipy's solver, losses and delays drawn by `jax.random`."""
    case = lossy_loop(sensors, **controller)
    record = jb.simulate(case)
    motion = expected(case, record.times)
    assert 1e-4 < np.max(np.abs(motion.deflection)) < 5e-3
    largest = np.max(np.abs(motion.arrived_readings), axis=0)
    assert_allclose(record.measured / largest, motion.arrived_readings / largest, rtol=0, atol=2e-7)
    scale = np.max(np.abs(motion.command))
    assert_allclose(record.command, motion.command, rtol=0, atol=2e-7 * scale)
    assert_allclose(record.deflection, motion.deflection, rtol=0, atol=1e-9)


def test_seed_and_sensors_have_losses_of_their_own():
    sensors = [jb.Sensor(0.2, dropout=0.5), jb.Sensor(0.2, dropout=0.5)]
    first, again, other = (
        jb.simulate(lossy_loop(sensors, jb.Run(0.06, 400.0, seed=seed))) for seed in (3, 3, 4)
    )
    assert_array_equal(first.measured, again.measured)
    assert np.any(first.measured[:, 0] != first.measured[:, 1])
    assert np.any(first.measured != other.measured)


def test_no_loss_and_no_jitter_change_nothing():
    plain = [jb.Sensor(0.2, filter=jb.Filter(40.0, 3)), jb.Sensor(0.4, delay=7e-3)]
    zero = [dataclasses.replace(sensor, dropout=0.0, jitter=0.0) for sensor in plain]
    run = jb.Run(0.06, 400.0)
    for delay in (None, PERIOD, 8e-3):
        ideal = jb.simulate(lossy_loop(plain, run, delay=delay, dropout=None, jitter=None))
        record = jb.simulate(lossy_loop(zero, run, delay=delay, dropout=0.0, jitter=0.0))
        assert_array_equal(record.peak_deflection, ideal.peak_deflection)
        assert_array_equal(record.measured, ideal.measured)


def uniform(seed, number, kind, count):
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), number + 1), kind)
    return np.asarray(jax.random.uniform(key, count))


def test_readings_without_a_controller():
    """Lost ones repeat the last one, late ones are those of earlier times."""
    rate, seed = 500.0, 7
    case = jb.Case(
        SPAN,
        sensors=[jb.Sensor(0.3), jb.Sensor(0.3, dropout=0.4), jb.Sensor(0.3, jitter=4e-3)],
        loads=[jb.MovingMass(mass=0.4, speed=2.4)],
        run=jb.Run(0.3, rate, seed=seed),
    )
    record = jb.simulate(case)
    ideal, lossy, late = record.measured.T
    lost = uniform(seed, 1, 1, ideal.size) < 0.4
    newest, held = 0.0, []
    for value, is_lost in zip(ideal, lost, strict=True):
        newest = newest if is_lost else value
        held.append(newest)
    assert_array_equal(lossy, held)
    delays = 4e-3 * uniform(seed, 2, 2, ideal.size)
    times = np.maximum(record.times - delays, 0.0)
    fine = jb.simulate(dataclasses.replace(case, run=jb.Run(0.3, 20_000.0)))
    # linear between times of 0.05 ms: an error of 2e-4 of the largest, at most
    exact = np.interp(times, fine.times, fine.measured[:, 0])
    assert_allclose(late, exact, rtol=0, atol=1e-3 * np.max(np.abs(ideal)))
    assert np.max(np.abs(late - ideal)) > 0.02 * np.max(np.abs(ideal))


def test_readings_in_vehicles():
    """Lost ones repeat the last one; random numbers follow those of the sensors on the beam."""
    case = jb.Case(
        SPAN,
        sensors=[jb.Sensor(0.3)],
        loads=[jb.QuarterCar(0.05, 0.02, 60.0, 0.6, 400.0, 0.1, speed=5.0)],
        vehicle_sensors=[
            jb.vehicles.VehicleSensor(),
            jb.vehicles.VehicleSensor(dropout=0.5),
        ],
        run=jb.Run(0.1, 500.0, seed=2),
    )
    ideal, lossy = jb.simulate(case).vehicle_readings.T
    lost = uniform(2, 2, 1, ideal.size) < 0.5
    newest = np.maximum.accumulate(np.where(lost, 0, np.arange(ideal.size)))
    assert_array_equal(lossy[~lost], ideal[~lost])
    assert_array_equal(lossy, lossy[newest])


@pytest.mark.parametrize("address", ["sensors.0.dropout", "sensors.0.jitter", "controller.jitter"])
def test_derivatives_by_what_is_random_are_refused(address):
    run = jb.Run(0.02, 400.0)
    case = lossy_loop([jb.Sensor(0.2, dropout=0.1, jitter=1e-3), jb.Sensor(0.4)], run)

    def peak(value):
        return jb.simulate(jb.replace(case, {address: value})).peak_deflection[0]

    with pytest.raises(ValueError, match="drawn by a seed and jumps with the"):
        jax.grad(peak)(1e-3)


ERRORS = [
    ({"sensors.0.dropout": 1.0}, "sensors.0.dropout must lie from 0 to below 1; it is 1"),
    ({"controller.dropout": -0.1}, "controller.dropout must lie from 0 to below 1; it is -0.1"),
    ({"sensors.0.jitter": -1e-3}, "sensors.0.jitter must not be negative; it is -0.001 s"),
]


@pytest.mark.parametrize(("values", "message"), ERRORS)
def test_impossible_numbers_are_refused(values, message):
    case = lossy_loop([jb.Sensor(0.2, dropout=0.1, jitter=1e-3), jb.Sensor(0.4)])
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(jb.replace(case, values))


@pytest.mark.parametrize("name", ["dropout", "jitter"])
def test_controllers_in_continuous_time_lose_nothing(name):
    continuous = jb.Feedback([400.0, 200.0])
    case = lossy_loop([jb.Sensor(0.2), jb.Sensor(0.4)])
    with_key = dataclasses.replace(continuous, **{name: 1e-3})
    message = f"controller.{name} needs a controller that samples: give controller.period"
    with pytest.raises(ValueError, match=message):
        check_case(dataclasses.replace(case, controller=with_key))
    sensors = dataclasses.replace(case.sensors[0], **{name: 1e-3}), case.sensors[1]
    with pytest.raises(ValueError, match=f"sensors.0.{name} needs a controller that samples"):
        check_case(dataclasses.replace(case, sensors=sensors, controller=continuous))


@pytest.mark.parametrize("address", ["sensors.0.dropout", "controller.jitter"])
def test_sweeps_of_loops_refuse_what_changes_the_schedule(address):
    case = lossy_loop([jb.Sensor(0.2, dropout=0.1), jb.Sensor(0.4)])
    with pytest.raises(ValueError, match=f"{address} determines the schedule"):
        jb.sweep(case, {address: [0.0, 1e-3]})


def test_sweeps_over_other_numbers_have_the_same_losses():
    run = jb.Run(0.06, 400.0)
    case = lossy_loop([jb.Sensor(0.2, dropout=0.3), jb.Sensor(0.4, jitter=2e-3)], run)
    masses = [0.3, 0.4]
    runs = jb.sweep(case, {"loads.0.mass": masses})
    for mass, peak in zip(masses, np.asarray(runs.peak_deflection), strict=True):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}))
        assert_allclose(peak, record.peak_deflection, rtol=1e-6)
