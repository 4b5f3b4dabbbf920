"""Runs against closed forms and limits: moving force, light mass, slow mass."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from tests.differences import assert_close, plan_of
from tests.oracles import modal_equations
from tests.oracles.closed_forms import (
    cancellation_speed,
    critical_speed,
    influence_line,
    moving_force,
)
from tests.oracles.crossing import GRAVITY, Load
from tests.simulation.pinned_span import SENSORS, SPAN, TIMES, case_of

pytestmark = pytest.mark.filterwarnings(
    # the model is bilateral, the oracles too
    "ignore::jaxbeam.simulation.simulate.ContactLossWarning"
)


@pytest.fixture(scope="module")
def one_force():
    """Function that simulates a force of 3 N on the undamped span for two crossing times."""
    case = case_of(UNDAMPED, [Load(3.0 / GRAVITY, 1.0, kind="force")])
    plan = plan_of(case)

    def run(speed):
        times = np.linspace(0.0, 2 * SPAN.length / speed, 101)
        return jb.simulate(jb.replace(case, {"loads.0.speed": speed}), jnp.asarray(times), plan)

    return run


UNDAMPED = dataclasses.replace(SPAN, damping_ratio=0.0)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 1.0, 1.0 + 1e-9, 2.0, 3.7])
def test_moving_force_has_its_closed_form_at_every_speed(one_force, ratio):
    record = one_force(ratio * critical_speed(UNDAMPED))
    q, u = moving_force(UNDAMPED, 3.0, ratio * critical_speed(UNDAMPED), np.asarray(record.times))
    assert_close(record.deflection, q @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)
    assert_close(record.velocity, u @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)


@pytest.mark.parametrize(("mode", "order"), [(1, 1), (2, 1), (3, -1)])
def test_force_at_a_cancellation_speed_leaves_its_mode_at_rest(one_force, mode, order):
    record = one_force(cancellation_speed(UNDAMPED, mode, order))
    q = np.abs(record.coordinates[:, mode - 1])
    assert q[51:].max() < 1e-10 * q.max()


def test_light_mass_of_equal_weight_converges_to_the_force(one_mass):
    """At first order in the inertia."""
    load = Load(0.3, 2.0)
    force = modal_equations.respond(
        SPAN, [dataclasses.replace(load, kind="force")], SENSORS, TIMES
    ).deflection
    errors = []
    for share in (1e-3, 1e-4):
        light = dataclasses.replace(load, mass=share * load.mass)
        record = one_mass(light, **{"run.gravity": GRAVITY / share})
        errors.append(np.max(np.abs(record.deflection - force)) / np.max(np.abs(force)))
    assert_allclose(errors[0] / errors[1], 10.0, rtol=0.01)
    assert errors[1] < 1e-4


def test_slow_mass_has_the_static_deflection(one_mass):
    """Extrapolated to zero speed: errors are linear (damping) and quadratic (inertia) in it."""
    positions = np.linspace(0.3, 0.45, 101)  # set down at midspan; vibration decays
    first, second, third = (
        one_mass(
            Load(0.3, v, entry_time=-0.3 / v),
            times=(positions - 0.3) / v,
            **{"beam.damping_ratio": 0.2},
        ).deflection
        for v in (0.08, 0.04, 0.02)
    )
    extrapolated = (first - 6 * second + 8 * third) / 3
    weight = 0.3 * GRAVITY
    shapes = SPAN.shapes(np.array(SENSORS)) / SPAN.frequencies**2
    static = -weight * SPAN.shapes(positions) @ shapes.T
    end = slice(85, None)
    assert_close(extrapolated[end], static[end], 1e-7)
    exact = [influence_line(0.6, 11.68, "pinned-pinned", x, positions[end]) for x in SENSORS]
    assert_close(extrapolated[end], weight * np.array(exact).T, 5e-3)  # four modes
