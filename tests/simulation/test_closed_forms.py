"""Runs under a moving force against its closed form."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from tests.differences import assert_close, plan_of
from tests.oracles.closed_forms import (
    critical_speed,
    moving_force,
)
from tests.oracles.crossing import GRAVITY, Load
from tests.simulation.pinned_span import SENSORS, SPAN, case_of

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
