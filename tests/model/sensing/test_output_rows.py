"""Rows of every quantity: against the deflection's own derivatives, and on states and histories."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.quantities import QUANTITIES, Quantity, quantity_of
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.sensing.output_rows import band_weights, modal_row, quantity_history, sensor_rows
from jaxbeam.model.static_correction import Motion

FIBRE, MODULUS = 0.003, 2e-6
CASE = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, modes=4),
    supports=[jb.Support(0.7, stiffness=3e3, damping=2.0)],
    actuators=[jb.Shaker(0.3, stiffness=100.0, damping=1.0)],
)


def sensor(name: str) -> jb.Sensor:
    """A sensor of a quantity, with a fibre distance where it needs one."""
    quantity = QUANTITIES[name]
    return jb.Sensor(
        0.45,
        name,
        fibre_distance=FIBRE if quantity.at_fibre else None,
        section_modulus=MODULUS if quantity.over_modulus else None,
    )


@pytest.mark.parametrize("name", QUANTITIES)
def test_rows_are_x_derivatives_of_the_deflection(name):
    """By central differences of one order less."""
    quantity, model, h = QUANTITIES[name], modal_model(CASE), 1e-5
    lower = max(quantity.x_derivative - 1, 0)
    shapes = model.shapes(jnp.array([0.45 - h, 0.45, 0.45 + h]), (lower,))[0]
    expected = (shapes[2] - shapes[0]) / (2 * h) if quantity.x_derivative else shapes[1]
    expected = -FIBRE * expected if quantity.at_fibre else expected
    expected = 11.68 * expected if quantity.section_force else expected
    expected = expected / MODULUS if quantity.over_modulus else expected
    found = modal_row(model.fields, CASE, 0.45, name, FIBRE, MODULUS)
    assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", QUANTITIES)
def test_outputs_on_states_are_those_of_histories(name):
    """y = C z + D u and y = C z + C' z' against the history of the modal coordinates."""
    model, rows = modal_model(CASE), sensor_rows(modal_model(CASE), CASE, [sensor(name)])
    rng = np.random.default_rng(3)
    state, command = rng.normal(size=model.state_count), rng.normal(size=1)
    rate = model.A @ state + model.command_matrix @ command
    motion = state[model.coordinate_index], state[model.rate_index], rate[model.rate_index]
    expected = (rows.rows @ motion[QUANTITIES[name].time_derivative])[:1]
    if not QUANTITIES[name].bends:
        histories = Motion(*(part[None] for part in motion), *np.zeros((2, 1, 0)), np.zeros((1, 1)))
        history = quantity_history(CASE, model.modes, histories, 0.45, name)
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
    monkeypatch.setitem(QUANTITIES, "rotation_rate", Quantity("rad/s", 1, 1))
    model = modal_model(CASE)
    rows = sensor_rows(model, CASE, [jb.Sensor(0.45, "rotation_rate")])
    slope = sensor_rows(model, CASE, [jb.Sensor(0.45, "slope")])
    assert_allclose(rows.rows, slope.rows, rtol=1e-15)
    assert rows.time_derivatives == (1,) and jb.Sensor(0.45, "rotation_rate").unit == "rad/s"


def test_rates_of_curvatures_are_refused(monkeypatch):
    """Curvatures are statically corrected; the rate of their correction is not known."""
    monkeypatch.setitem(QUANTITIES, "strain_rate", Quantity("1/s", 2, 1, at_fibre=True))
    sentence = "strain_rate is a rate of a curvature, which has no static correction"
    with pytest.raises(ValueError, match=sentence):
        sensor_rows(modal_model(CASE), CASE, [jb.Sensor(0.45, "strain_rate", fibre_distance=0.01)])


def test_unknown_quantities_and_missing_fibres_are_refused():
    with pytest.raises(ValueError, match="no quantity 'torsion'; there are deflection, velocity"):
        quantity_of("torsion")
    with pytest.raises(ValueError, match="strain needs fibre_distance, the height above"):
        quantity_of("strain")
    with pytest.raises(ValueError, match="stress needs section_modulus, bending moment over"):
        quantity_of("stress", 0.1)


def test_active_moments_of_commands_belong_to_moment_and_stress():
    """A patch alone on a pinned beam: the section over it carries no moment, by commands alone."""
    case = dataclasses.replace(CASE, supports=(), actuators=(jb.Patch(0.4, 0.5, 2e-3),))
    sensors = [sensor("moment"), sensor("stress"), sensor("curvature"), jb.Sensor(0.6, "moment")]
    rows = sensor_rows(modal_model(case), case, sensors)
    assert_allclose(rows.on_commands[:, 0], [2e-3, 2e-3 / MODULUS, 0.0, 0.0])
    _, D = rows.of_system(modal_model(case), np.eye(8), np.ones((8, 1)))
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
