"""Sensors: readings from histories of deflection, velocity and acceleration."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.sensors import (
    QUANTITIES as ROW_QUANTITIES,
    TWIST,
    Filter,
    Quantity,
    Sensor,
    analogue_state_space,
    analogue_steady_state,
    filter_history,
    filter_step,
    quantity_of,
    second_order_sections,
    steady_filter_state,
)
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import band_weights, modal_row, quantity_history, sensor_rows
from jaxbeam.model.sensor_signals import (
    filtered_reading,
    initial_filter_state,
    noise_samples,
    sampled_readings,
    sensor_readings,
    sensor_sections,
    to_reading,
)
from jaxbeam.model.static_correction import Motion
from jaxbeam.numerics.stages import c2d

TIMES = jnp.arange(201) / 1000.0
OMEGA = 2 * np.pi * np.array([3.0, 8.0])


def signal(t, derivative=0):
    """A smooth signal that starts from rest, and its derivatives by time."""
    t = np.asarray(t)
    if derivative:
        return sum(w * np.sin(w * t) for w in OMEGA)
    return sum(1 - np.cos(w * t) for w in OMEGA)


VALUES, RATES = jnp.asarray(signal(TIMES)), jnp.asarray(signal(TIMES, 1))


def test_offset_noise_range_and_resolution_in_this_order():
    sensor = Sensor(0.3, offset=0.5, noise=0.1, range=[-2.0, 2.0], resolution=0.25)
    found = to_reading(sensor, jnp.array([0.0, 0.0, 1.4, -9.0]), jnp.array([0.0, 2.0, 1.0, 1.0]))
    assert_allclose(found, [0.5, 0.75, 2.0, -2.0], rtol=0, atol=0)
    assert_allclose(to_reading(sensor, 0.3), 0.75)  # without noise


def test_derivatives_pass_through_rounding_and_stop_at_the_range():
    sensor = Sensor(0.3, range=[-2.0, 2.0], resolution=0.25)
    slope = jax.vmap(jax.grad(lambda v: to_reading(sensor, v)))(jnp.array([0.3, 1.9, 2.1, -5.0]))
    assert_allclose(slope, [1.0, 1.0, 0.0, 0.0], rtol=0, atol=0)


def test_noise_depends_on_the_seed_and_has_the_stated_deviation():
    samples = noise_samples(3, 2, 20000)
    assert_array_equal(samples, noise_samples(3, 2, 20000))
    assert_array_equal(samples[:, 0], noise_samples(3, 1, 20000)[:, 0])
    assert np.max(np.abs(samples - noise_samples(4, 2, 20000))) > 1
    assert Sensor(0.3, noise=0.1).noise_variance == 0.1**2 and Sensor(0.3).noise_variance == 0
    assert_allclose(np.std(samples, axis=0), 1.0, atol=0.02)
    assert_allclose(np.corrcoef(samples.T)[0, 1], 0.0, atol=0.03)


def test_readings_sample_by_sample_are_those_of_the_whole_history():
    sensor = Sensor(0.3, offset=0.2, noise=0.01, resolution=1e-3, filter=Filter(20.0, 3))
    noise = noise_samples(0, 1, 201)[:, 0]
    sections = sensor_sections(sensor, 1e-3)
    filter_state = initial_filter_state(sensor, sections, jnp.zeros(()))
    step = jax.jit(filtered_reading)
    found = []
    for value, drawn in zip(VALUES, noise, strict=True):
        reading, filter_state = step(sensor, sections, filter_state, value, drawn)
        found.append(reading)
    assert_allclose(
        found, sampled_readings(sensor, TIMES, VALUES, RATES, noise), rtol=0, atol=1e-13
    )
    batch = initial_filter_state(sensor, sections, jnp.zeros(4))
    together, _ = filtered_reading(sensor, sections, batch, jnp.linspace(0, 1, 4), None)
    alone, _ = filtered_reading(sensor, sections, batch[..., 2], jnp.array(2 / 3), None)
    assert_allclose(together[2], alone, rtol=1e-14)


def test_a_digital_filter_is_that_of_scipy_from_rest():
    sensor = Sensor(0.3, offset=0.7, filter=Filter(15.0, 6))
    sos = scipy.signal.butter(6, 15.0, fs=1000.0, output="sos")
    rest = scipy.signal.sosfilt_zi(sos) * 0.7
    expected = scipy.signal.sosfilt(sos, np.asarray(VALUES) + 0.7, zi=rest)[0]
    assert_allclose(sampled_readings(sensor, TIMES, VALUES, RATES), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("order", [1, 4])
def test_an_analogue_filter_is_that_of_scipy(order):
    sensor = Sensor(0.3, filter=Filter(15.0, order, realisation="analogue"))
    fine = np.linspace(0.0, 0.2, 20001)  # lsim takes the signal to be straight in between
    system = scipy.signal.butter(order, 2 * np.pi * 15.0, analog=True)
    expected = scipy.signal.lsim(system, signal(fine), fine)[1][::100]
    found = sampled_readings(sensor, TIMES, VALUES, RATES)
    assert_allclose(found, expected, rtol=0, atol=1e-7)


def test_delayed_readings_are_those_of_an_earlier_signal():
    whole = sampled_readings(Sensor(0.3, delay=0.01), TIMES, VALUES, RATES)
    assert_allclose(whole[10:], VALUES[:-10], rtol=0, atol=1e-13)
    assert_allclose(whole[:10], 0.0, atol=1e-15)
    between = sampled_readings(Sensor(0.3, delay=0.00437), TIMES, VALUES, RATES)
    # Cubics are right to (omega h)^4 / 384.
    assert_allclose(between[5:], signal(TIMES - 0.00437)[5:], rtol=0, atol=5e-8)


def test_readings_are_held_between_sampling_instants():
    sensor = Sensor(0.3, sampling_period=0.004, noise=0.1)
    noise = noise_samples(0, 1, 201)[:, 0]
    found = sampled_readings(sensor, TIMES, VALUES, RATES, noise)
    expected = np.repeat(VALUES[::4] + 0.1 * noise[: len(VALUES[::4])], 4)[:201]
    assert_allclose(found, expected, rtol=0, atol=1e-13)
    # Not a multiple of the time between samples: the readings are those at its own times.
    odd = sampled_readings(Sensor(0.3, sampling_period=0.0033), TIMES, VALUES, RATES)
    instants = 0.0033 * np.floor(np.asarray(TIMES) / 0.0033 + 1e-9)
    assert_allclose(odd, signal(instants), rtol=0, atol=5e-8)


def test_a_digital_filter_runs_at_the_sampling_period_of_its_sensor():
    sensor = Sensor(0.3, sampling_period=0.004, filter=Filter(20.0, 3))
    sos = scipy.signal.butter(3, 20.0, fs=250.0, output="sos")
    expected = np.repeat(scipy.signal.sosfilt(sos, VALUES[::4]), 4)[:201]
    assert_allclose(sampled_readings(sensor, TIMES, VALUES, RATES), expected, rtol=0, atol=1e-12)


def test_unsuitable_times_are_refused():
    uneven = TIMES.at[7].add(3e-4)
    for realisation in ("digital", "analogue"):
        sensor = Sensor(0.3, filter=Filter(20.0, 3, realisation=realisation))
        with pytest.raises(ValueError, match="equal spacing"):
            sampled_readings(sensor, uneven, VALUES, RATES)
    fast = Sensor(0.3, sampling_period=1e-4, filter=Filter(20.0, 3))
    with pytest.raises(ValueError, match="a reading every 0.0001 s, but .* 0.001 s apart"):
        sampled_readings(fast, TIMES, VALUES, RATES)


QUANTITIES = [("deflection", None), ("velocity", None), ("acceleration", None), ("strain", 0.002)]
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
    sensors=[Sensor(0.25, quantity, fibre_distance=z) for quantity, z in QUANTITIES],
    loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    run=jb.Run(0.4, sample_rate=2000.0, seed=11),
)


@pytest.fixture(scope="module")
def record():
    return jb.simulate(CASE)


def with_sensors(record, **changes):
    """The same run with other properties of the sensors."""
    sensors = tuple(dataclasses.replace(s, **changes) for s in CASE.sensors)
    return dataclasses.replace(record, case=dataclasses.replace(CASE, sensors=sensors))


def test_ideal_sensors_read_the_true_values(record):
    truth = [record.at(0.25, quantity, z) for quantity, z in QUANTITIES]
    assert_array_equal(record.measured, np.array(truth).T)


def test_a_record_reads_every_quantity_through_filter_and_delay(record):
    filter = Filter(40.0, 4)
    found = with_sensors(record, filter=filter, delay=0.004).measured
    sos = scipy.signal.butter(4, 40.0, fs=2000.0, output="sos")
    delayed = np.asarray(record.measured)[np.maximum(np.arange(801) - 8, 0)]
    rest = scipy.signal.sosfilt_zi(sos)[:, :, None] * delayed[0]
    expected = scipy.signal.sosfilt(sos, delayed, axis=0, zi=rest)[0]
    assert_allclose(found, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected), axis=0).max())
    analogue = Filter(40.0, 4, realisation="analogue")
    smooth = with_sensors(record, filter=analogue, delay=0.004).measured
    size = np.max(np.abs(expected), axis=0)
    assert np.all(np.max(np.abs(smooth - expected), axis=0) < 0.02 * size)


def test_noise_is_in_the_record_but_not_in_predictions(record):
    noisy = with_sensors(record, noise=1e-3)
    difference = np.asarray(noisy.measured - record.measured)
    assert_allclose(difference, 1e-3 * noise_samples(11, 4, 801), rtol=0, atol=1e-12)
    assert_array_equal(noisy.measured, noisy.measured)
    assert_array_equal(sensor_readings(noisy.case, noisy.modes, noisy.motion), record.measured)


def test_delayed_readings_without_times_are_refused(record):
    delayed = with_sensors(record, delay=0.1)
    with pytest.raises(ValueError, match=r"sensors.0 .* its readings need times"):
        sensor_readings(delayed.case, delayed.modes, delayed.motion)
    fast = with_sensors(record, filter=Filter(100.0), sampling_period=1e-4)
    with pytest.raises(ValueError, match=r"sensors.0: its filter takes a reading every 0.0001 s"):
        _ = fast.measured


def test_case_files_hold_every_property_of_a_sensor(tmp_path):
    filter = Filter(10.0, 10)
    sensor = Sensor(
        0.25, offset=1e-5, noise=1e-5, range=[-0.01, 0.01], resolution=1e-6, filter=filter,
        sampling_period=1e-3, delay=2e-4,
    )  # fmt: skip
    case = dataclasses.replace(CASE, sensors=(sensor, CASE.sensors[1]))
    jb.save_case(case, tmp_path / "case.toml")
    loaded = jb.load_case(tmp_path / "case.toml")
    assert jax.tree.structure(loaded) == jax.tree.structure(case)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), loaded, case))
    assert jb.replace(case, {"sensors.0.filter.cutoff": 12.0}).sensors[0].filter.cutoff == 12.0
    path = tmp_path / "table.toml"
    path.write_text(
        "[beam]\nlength = 0.6\nflexural_rigidity = 11.68\nmass_per_length = 0.535\n"
        "[[sensors]]\nposition = 0.3\n[sensors.filter]\ncutoff = 10\norder = 10\n"
    )
    assert jb.load_case(path).sensors[0].filter == filter


INVALID_SENSORS = [
    ({"resolution": 0.0}, "sensors.0.resolution must be positive; it is 0"),
    ({"noise": -1.0}, "sensors.0.noise must not be negative; it is -1"),
    ({"range": [1.0, -1.0]}, "sensors.0.range.1 must be above the entry before it; -1 follows 1"),
    ({"delay": -0.1}, "sensors.0.delay must not be negative; it is -0.1 s"),
    ({"sampling_period": 0.0}, "sensors.0.sampling_period must be positive; it is 0 s"),
    ({"sampling_period": 0.5}, "must not exceed the run's duration, 0.4 s; it is 0.5 s"),
    ({"filter": Filter(1000.0)}, "sensors.0.filter.cutoff must be below half the sampling freq"),
    ({"filter": Filter(60.0), "sampling_period": 0.01}, "frequency, 50 Hz; it is 60 Hz: lower it"),
    ({"filter": Filter(0.0)}, "sensors.0.filter.cutoff must be positive; it is 0 Hz"),
    ({"filter": Filter(9.0, 0)}, "sensors.0.filter.order must be a whole number, 1 or more"),
    ({"filter": Filter(9.0, kind="bessel")}, "sensors.0.filter.kind cannot be 'bessel'"),
]


@pytest.mark.parametrize(("changes", "message"), INVALID_SENSORS)
def test_invalid_sensors_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        check_case(dataclasses.replace(CASE, sensors=(Sensor(0.25, **changes),)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filter": Filter(1000.0)}, "filter.cutoff must be below half the sampling frequency"),
        (
            {"filter": Filter(60.0), "sampling_period": 0.01},
            "frequency, 50 Hz; it is 60 Hz: lower it",
        ),
        ({"sampling_period": 0.5}, "must not exceed the run's duration, 0.4 s; it is 0.5 s"),
    ],
)
def test_vehicle_sensors_are_refused_before_work_too(changes, message):
    load = jb.vehicles.VehicleLoad(model="half-truck", speed=2.0)
    sensors = (jb.vehicles.VehicleSensor(body="axle 1", **changes),)
    with pytest.raises(ValueError, match="vehicle_sensors.0.*" + message):
        check_case(dataclasses.replace(CASE, loads=(load,), vehicle_sensors=sensors))


@pytest.mark.parametrize(
    ("filter", "message"),
    [
        (10.0, "sensors.0.filter holds 10.0; it takes a table of its own"),
        ({"cutof": 10.0}, "sensors.0.filter has no key 'cutof'; did you mean 'cutoff'?"),
        ({"order": 3}, "sensors.0.filter.cutoff is missing"),
        ({"cutoff": "low"}, "sensors.0.filter.cutoff must be one number, not 'low'"),
    ],
)
def test_invalid_filter_tables_are_refused(filter, message):
    beam = {"length": 0.6, "flexural_rigidity": 11.68, "mass_per_length": 0.535}
    with pytest.raises(ValueError, match=re.escape(message)):
        case_from_dict({"beam": beam, "sensors": [{"position": 0.3, "filter": filter}]})


def test_the_bound_on_the_cutoff_needs_a_known_sampling_period():
    """None for an analogue filter, nor for one whose controller decides the sampling."""
    analogue = Filter(5000.0, realisation="analogue")
    check_case(dataclasses.replace(CASE, sensors=(Sensor(0.25, filter=analogue),)))


def test_seeds_are_whole_numbers():
    with pytest.raises(ValueError, match="run.seed must be a whole number, 0 or more; it is -1"):
        check_case(dataclasses.replace(CASE, run=jb.Run(0.4, seed=-1)))


# Rows of every quantity: against the deflection's own derivatives, and on states and histories.

FIBRE, MODULUS = 0.003, 2e-6
ROW_CASE = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, modes=6, torsional_rigidity=4.2, polar_inertia=2e-4),
    supports=[jb.Support(0.7, stiffness=3e3, damping=2.0)],
    actuators=[jb.Shaker(0.3, stiffness=100.0, damping=1.0)],
)


def sensor(name: str) -> jb.Sensor:
    """A sensor of a quantity, with a fibre distance where it needs one."""
    quantity = ROW_QUANTITIES[name]
    return jb.Sensor(
        0.45,
        name,
        fibre_distance=FIBRE if quantity.at_fibre else None,
        section_modulus=MODULUS if quantity.over_modulus else None,
    )


@pytest.mark.parametrize("name", ROW_QUANTITIES)
def test_rows_are_x_derivatives_of_the_deflection(name):
    """By central differences of one order less."""
    quantity, model, h = ROW_QUANTITIES[name], modal_model(ROW_CASE), 1e-5
    lower = TWIST if quantity.of_twist else max(quantity.x_derivative - 1, 0)
    shapes = model.fields(jnp.array([0.45 - h, 0.45, 0.45 + h]), (lower,))[0]
    expected = (shapes[2] - shapes[0]) / (2 * h) if quantity.x_derivative else shapes[1]
    expected = -FIBRE * expected if quantity.at_fibre else expected
    expected = 11.68 * expected if quantity.section_force else expected
    expected = 4.2 * expected if name == "torque" else expected
    expected = expected / MODULUS if quantity.over_modulus else expected
    found = modal_row(model.fields, ROW_CASE, 0.45, name, FIBRE, MODULUS)
    assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", ROW_QUANTITIES)
def test_outputs_on_states_are_those_of_histories(name):
    """y = C z + D u and y = C z + C' z' against the history of the modal coordinates."""
    model, rows = (
        modal_model(ROW_CASE),
        sensor_rows(modal_model(ROW_CASE), ROW_CASE, [sensor(name)]),
    )
    rng = np.random.default_rng(3)
    state, command = rng.normal(size=model.state_count), rng.normal(size=1)
    rate = model.A @ state + model.command_matrix @ command
    motion = state[model.coordinate_index], state[model.rate_index], rate[model.rate_index]
    expected = (rows.rows @ motion[ROW_QUANTITIES[name].time_derivative])[:1]
    if not ROW_QUANTITIES[name].bends:
        histories = Motion(*(part[None] for part in motion), *np.zeros((2, 1, 0)), np.zeros((1, 1)))
        history = quantity_history(ROW_CASE, model.modes, histories, 0.45, name)
        assert_allclose(history, expected, rtol=1e-12)
    C, D = rows.of_system(model, model.A, model.command_matrix)
    assert_allclose(C @ state + D @ command, expected, rtol=1e-12)
    on_states, on_rates = rows.on_states(model)
    assert_allclose(on_states @ state + on_rates @ rate, expected, rtol=1e-12)
    outputs = rows.with_accelerations(on_states @ state, jnp.asarray(motion[2]))
    assert_allclose(outputs, expected, rtol=1e-12)
    assert rows.has_feedthrough.tolist() == [sensor(name).has_feedthrough]


def test_a_quantity_is_declared_by_one_entry(monkeypatch):
    """Sensors of a rate of rotation, with unit and rows, by the entry alone."""
    monkeypatch.setitem(ROW_QUANTITIES, "rotation_rate", Quantity("rad/s", 1, 1))
    model = modal_model(ROW_CASE)
    rows = sensor_rows(model, ROW_CASE, [jb.Sensor(0.45, "rotation_rate")])
    slope = sensor_rows(model, ROW_CASE, [jb.Sensor(0.45, "slope")])
    assert_allclose(rows.rows, slope.rows, rtol=1e-15)
    assert rows.time_derivatives == (1,) and jb.Sensor(0.45, "rotation_rate").unit == "rad/s"


def test_rates_of_curvatures_are_refused(monkeypatch):
    """Curvatures are statically corrected; the rate of their correction is not known."""
    monkeypatch.setitem(ROW_QUANTITIES, "strain_rate", Quantity("1/s", 2, 1, at_fibre=True))
    sentence = "strain_rate is a rate of a curvature, which has no static correction"
    with pytest.raises(ValueError, match=sentence):
        sensor_rows(
            modal_model(ROW_CASE), ROW_CASE, [jb.Sensor(0.45, "strain_rate", fibre_distance=0.01)]
        )


def test_unknown_quantities_and_missing_fibres_are_refused():
    with pytest.raises(ValueError, match="no quantity 'torsion'; there are deflection, velocity"):
        quantity_of("torsion")
    with pytest.raises(ValueError, match="strain needs fibre_distance, the height above"):
        quantity_of("strain")
    with pytest.raises(ValueError, match="stress needs section_modulus, bending moment over"):
        quantity_of("stress", 0.1)


def test_active_moments_of_commands_belong_to_moment_and_stress():
    """A patch alone on a pinned beam: the section over it carries no moment, by commands alone."""
    case = dataclasses.replace(ROW_CASE, supports=(), actuators=(jb.Patch(0.4, 0.5, 2e-3),))
    sensors = [sensor("moment"), sensor("stress"), sensor("curvature"), jb.Sensor(0.6, "moment")]
    rows = sensor_rows(modal_model(case), case, sensors)
    assert_allclose(rows.on_commands[:, 0], [2e-3, 2e-3 / MODULUS, 0.0, 0.0])
    _, D = rows.of_system(modal_model(case), np.eye(12), np.ones((12, 1)))
    assert_allclose(D, rows.on_commands)


# Accelerations of the modes that count by EN 1990 against the sum of the lowest modes.

# 4, 16, 36, 64 Hz: three of the four count, the third beyond 30 Hz.
RIGIDITY = (4.0 * 2 * np.pi) ** 2 * 15000.0 * 25.0**4 / np.pi**4
BANDED = jb.Sensor(12.5, "acceleration", mode_band="en1990")
BAND_CASE = jb.Case(
    jb.Beam(25.0, RIGIDITY, 15000.0, damping_ratio=0.01, modes=5),
    sensors=[BANDED, jb.Sensor(12.5, "acceleration")],
    loads=[jb.MovingForce(force=1e5, speed=50.0)],
    run=jb.Run(0.7, sample_rate=2000.0),
)


def test_modes_of_the_band():
    assert_allclose(band_weights(jb.modes(BAND_CASE), "en1990"), [1, 1, 1, 0, 0])


def test_readings_extremes_and_sweeps_have_the_modes_of_the_band():
    record = jb.simulate(BAND_CASE)
    fewer = dataclasses.replace(
        BAND_CASE,
        beam=dataclasses.replace(BAND_CASE.beam, modes=3),
        sensors=[jb.Sensor(12.5, "acceleration")],
    )
    expected = np.asarray(jb.simulate(fewer).sensor_values[:, 0])
    values = np.asarray(record.sensor_values)
    size = np.abs(expected).max()
    assert_allclose(values[:, 0], expected, rtol=0, atol=1e-6 * size)
    assert np.abs(values[:, 1] - expected).max() > 0.05 * size
    assert_allclose(record.measured[:, 0], values[:, 0], rtol=1e-12)
    largest = max(record.extremes.largest[0], -record.extremes.smallest[0])
    assert_allclose(largest, size, rtol=2e-3)
    assert largest >= size * (1 - 1e-7)
    swept = jb.sweep(BAND_CASE, {"loads.0.speed": [50.0]}, progress=False)
    assert_allclose(swept["peak_acceleration"][0, 0], largest, rtol=1e-6)


def test_corrected_quantities_have_no_band():
    with pytest.raises(ValueError, match=r"sensors.0.mode_band would have no effect .* moment"):
        jb.simulate(
            dataclasses.replace(BAND_CASE, sensors=[jb.Sensor(1.0, "moment", mode_band="en1990")])
        )


# Filters against scipy.signal, and their derivatives against differences.

ORDERS = [1, 2, 3, 5, 10]
PERIOD = 1e-3
SIGNAL = np.random.default_rng(7).normal(size=(400, 3)).cumsum(axis=0)


def scipy_sections(order, cutoff):
    """Sections of the same digital filter by scipy."""
    return scipy.signal.butter(order, cutoff, fs=1 / PERIOD, output="sos")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("cutoff", [10.0, 120.0, 480.0])
def test_frequency_response_of_a_digital_filter(order, cutoff):
    frequencies = np.linspace(0.01, 499.0, 200)
    ours = np.asarray(second_order_sections(Filter(cutoff, order), PERIOD))
    found = scipy.signal.sosfreqz(ours, frequencies, fs=1 / PERIOD)[1]
    expected = scipy.signal.sosfreqz(scipy_sections(order, cutoff), frequencies, fs=1 / PERIOD)[1]
    significant = np.abs(expected) > 1e-12
    assert_allclose(found[significant], expected[significant], rtol=1e-9)
    at_cutoff = scipy.signal.sosfreqz(ours, [cutoff], fs=1 / PERIOD)[1]
    assert_allclose(np.abs(at_cutoff), 1 / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("cutoff", [10.0, 120.0])
def test_history_equals_sosfilt(order, cutoff):
    rows = second_order_sections(Filter(cutoff, order), PERIOD)
    rest = steady_filter_state(rows, np.zeros(3))
    expected = scipy.signal.sosfilt(scipy_sections(order, cutoff), SIGNAL, axis=0)
    found = filter_history(rows, rest, jnp.asarray(SIGNAL))
    assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(SIGNAL)))


def test_steps_add_up_to_the_history():
    rows = second_order_sections(Filter(40.0, 5), PERIOD)
    state = steady_filter_state(rows, np.ones(3))
    expected = filter_history(rows, state, jnp.asarray(SIGNAL[:20]))
    for sample, output in zip(SIGNAL[:20], expected, strict=True):
        found, state = filter_step(rows, state, jnp.asarray(sample))
        assert_allclose(found, output, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
def test_steady_state_is_kept_under_a_constant_input(order):
    rows = second_order_sections(Filter(20.0, order), PERIOD)
    level = np.array([2.0, -3.0, 0.5])
    found = filter_history(rows, steady_filter_state(rows, level), jnp.broadcast_to(level, (50, 3)))
    assert_allclose(found, np.broadcast_to(level, (50, 3)), rtol=1e-9)


def test_each_run_of_a_batch_may_have_its_own_filter():
    cutoffs = jnp.array([10.0, 50.0, 200.0])
    rows = jax.vmap(lambda c: second_order_sections(Filter(c, 3), PERIOD), out_axes=-1)(cutoffs)
    found = filter_history(rows, steady_filter_state(rows, np.zeros(3)), jnp.asarray(SIGNAL))
    for i, cutoff in enumerate(cutoffs):
        expected = scipy.signal.sosfilt(scipy_sections(3, float(cutoff)), SIGNAL[:, i])
        assert_allclose(found[:, i], expected, rtol=0, atol=1e-11 * np.max(np.abs(SIGNAL)))


def test_output_is_held_between_new_samples():
    rows = second_order_sections(Filter(50.0, 4), 5 * PERIOD)
    new, start = jnp.array(np.arange(400) % 5 == 0), steady_filter_state(rows, np.zeros(3))
    found = filter_history(rows, start, jnp.asarray(SIGNAL), new)
    slow = filter_history(rows, start, jnp.asarray(SIGNAL[::5]))
    assert_allclose(found, np.repeat(slow, 5, axis=0), rtol=0, atol=0)


def test_cutoff_above_half_the_sampling_frequency_is_refused():
    with pytest.raises(ValueError, match="below half the sampling frequency, 500 Hz; it is 500 Hz"):
        second_order_sections(Filter(500.0, 2), PERIOD)


@pytest.mark.parametrize("order", ORDERS)
def test_frequency_response_of_an_analogue_filter(order):
    cutoff = 30.0
    analogue = Filter(cutoff, order, realisation="analogue")
    matrix, column, row, direct = analogue_state_space(analogue)
    omega = 2 * np.pi * np.logspace(-1, 3, 60)
    inverse = np.linalg.inv(1j * omega[:, None, None] * np.eye(order) - np.asarray(matrix))
    found = np.einsum("i,wij,j->w", row, inverse, column) + direct
    zeros, poles, gain = scipy.signal.buttap(order)
    poles, gain = 2 * np.pi * cutoff * poles, gain * (2 * np.pi * cutoff) ** order
    expected = scipy.signal.freqs_zpk(zeros, poles, gain, omega)[1]
    assert_allclose(found, expected, rtol=1e-8, atol=1e-14)
    rest = analogue_steady_state(Filter(cutoff, order), 2.0)
    assert_allclose(matrix @ rest + column * 2.0, 0.0, atol=1e-12)
    assert_allclose(row @ rest, 2.0, rtol=1e-15)


@pytest.mark.parametrize("order", [1, 4, 7])
def test_discretisation_with_polynomial_holds_is_exact(order):
    """Zero order against cont2discrete, first order against lsim, cubics against half steps."""
    matrix, column, row, direct = analogue_state_space(Filter(30.0, order))
    system = matrix, column[:, None], row[None], direct[None, None]
    transition, inputs = c2d(matrix, column[:, None], PERIOD)
    discrete = scipy.signal.cont2discrete([np.asarray(x) for x in system], PERIOD)
    assert_allclose(transition, discrete[0], rtol=1e-12, atol=1e-13)
    assert_allclose(inputs[0], discrete[1], rtol=1e-10, atol=1e-14)

    transition, inputs = c2d(matrix, column[:, None], PERIOD, degree=1)
    times, signal = PERIOD * np.arange(400), SIGNAL[:, 0]
    expected = scipy.signal.lsim([np.asarray(x) for x in system], signal, times)[2]
    state, found = np.zeros(order), [np.zeros(order)]
    for value, rise in zip(signal[:-1], np.diff(signal), strict=True):
        state = transition @ state + inputs[0, :, 0] * value + inputs[1, :, 0] * rise
        found.append(state)
    assert_allclose(found, np.asarray(expected).reshape(400, order), rtol=0, atol=1e-9)

    cubic = np.array([1.0, -2.0, 0.5, 3.0])  # in s / h; its halves in s / (h / 2), from the start
    second = np.polynomial.Polynomial(cubic)(np.polynomial.Polynomial([0.5, 0.5])).coef
    transition, inputs = c2d(matrix, column[:, None], 0.02, degree=3)
    half_transition, half_inputs = c2d(matrix, column[:, None], 0.01, degree=3)
    middle = np.tensordot(cubic * 0.5 ** np.arange(4), half_inputs[..., 0], axes=1)
    expected = half_transition @ middle + np.tensordot(second, half_inputs[..., 0], axes=1)
    assert_allclose(np.tensordot(cubic, inputs[..., 0], axes=1), expected, rtol=1e-11)
