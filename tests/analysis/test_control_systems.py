"""Objects of python-control against matrices assembled here, poles, and a simulated run."""

import dataclasses

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.stationary_loop import loop_with_mass_at
from tests.analysis.test_stationary_loop import (
    MASS,
    POSITION,
    SENSOR,
    lagging_case,
    loop_of_matrices,
)
from tests.loop_as_oracle import span_of

FREQUENCIES = np.geomspace(1.0, 2000.0, 9)  # rad/s


def response(system):
    return control.frequency_response(system, FREQUENCIES, squeeze=False).complex


def test_continuous_loop_with_a_mass_at_a_position():
    """Of open and closed loop: poles and frequency responses."""
    systems, expected = (
        jb.to_control(lagging_case(), POSITION, MASS),
        loop_of_matrices(lagging_case()),
    )
    scale = np.abs(response(expected)).max()
    assert_allclose(-response(systems.loop), response(expected), atol=1e-9 * scale)
    closed = control.feedback(expected, 1)
    assert_allclose(np.sort_complex(systems.closed.poles()), np.sort_complex(closed.poles()))
    assert_allclose(
        np.sort_complex(systems.plant.poles()), np.sort_complex(expected.poles()), rtol=1e-9
    )


def test_plant_from_the_weight_to_the_reading():
    """-psi(sensor)' (K - w^2 M + i w C)^-1 psi(position), M with the mass."""
    case = dataclasses.replace(lagging_case(), controller=None)
    plant, loop, closed = jb.to_control(case, POSITION, MASS)
    assert (plant.input_labels, plant.output_labels) == (
        ["command_0", "load_0"],
        ["sensor_0_deflection"],
    )
    assert loop is None and closed is None
    span = span_of(case)
    shape, reading = span.shapes(POSITION), span.shapes(SENSOR)
    inertia = np.eye(2) + MASS * np.outer(shape, shape)
    stiffness = np.diag(span.frequencies**2)
    expected = [
        -reading @ np.linalg.solve(stiffness - w**2 * inertia + 1j * w * span.damping, shape)
        for w in FREQUENCIES
    ]
    scale = np.abs(expected).max()
    assert_allclose(response(plant)[0, 1], expected, atol=1e-9 * scale)


def test_sampled_loop_has_its_period_and_poles():
    controller = jb.Feedback([40.0], period=0.004, delay=0.001)
    case = dataclasses.replace(lagging_case(), controller=controller)
    systems = jb.to_control(case, POSITION)  # with the 0.3 kg of its load
    assert systems.closed.dt == 0.004 and systems.closed.output_labels == ["law_0"]
    poles = loop_with_mass_at(case, POSITION, 0.3).poles()
    found = np.log(systems.closed.poles().astype(complex)) / 0.004
    kept = poles[poles.real > -1e4]
    assert_allclose(np.sort_complex(found[found.real > -1e4]), np.sort_complex(kept), rtol=1e-6)
    unloaded = jb.to_control(case)
    assert unloaded.plant.input_labels == ["command_0"]
    assert np.abs(unloaded.closed.poles() - systems.closed.poles()).max() > 1e-3


def test_errors():
    case = lagging_case()
    with pytest.raises(ValueError, match="mass needs a position"):
        jb.to_control(case, mass=0.2)
    with pytest.raises(ValueError, match="the mass at 0.7 m is off the beam"):
        jb.to_control(case, 0.7)
    with pytest.raises(ValueError, match="mass must be given"):
        jb.to_control(dataclasses.replace(case, loads=()), 0.2)
