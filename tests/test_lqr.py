"""Linear-quadratic regulators: gains and closed loops computed independently, costs, optimality."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.control import LQR, AugmentedLQR, FiniteLQR, StepLQR
from jaxbeam.control.beliefs import Beliefs

REFERENCE = json.loads((Path(__file__).parent / "data" / "optimal_control.json").read_text())
SHARES = np.array(REFERENCE["fractions_of_crossing"])
WEIGHTS = {
    "state_weight": REFERENCE["case"]["Q"],
    "command_weight": [REFERENCE["case"]["R"]],
    "coordinates": "sine",
}
FEW = [1, 1, 0, 1, 0, 0, 0]  # q1, q2 and the rate of q1 are fed back
DESIGN = Beliefs(force_per_volt=4.6)


def rig(controller=None, force_per_volt=4.6, **run):
    shaker = jb.Shaker(0.5, 12000.0, 80.0, force_per_volt=force_per_volt, bandwidth=1e4)
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3),
        actuators=[shaker],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=0.509, speed=0.55)],
        controller=controller,
        run=jb.Run(**({"duration": 1.4, "sample_rate": 200.0} | run)),
    )


@pytest.fixture(scope="module")
def model():
    return jb.state_space(rig(), "sine")


def gains_at(regulator, model, shares=SHARES):
    return eqx.filter_jit(lambda m: jax.vmap(regulator.gains(m))(jnp.asarray(shares)))(model)


def test_time_invariant_gain(model):
    gain = LQR(**WEIGHTS).gains(model)
    assert_allclose(gain[0], REFERENCE["time_invariant_gain"], rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "points", "name"),
    [
        (StepLQR, 200, "step_by_step_gains"),
        (FiniteLQR, 1200, "finite_time_gains"),
        (AugmentedLQR, 1200, "augmented_finite_time_gains"),
    ],
)
def test_gains_over_the_crossing(model, kind, points, name):
    gains = gains_at(kind(**WEIGHTS, points=points), model)[:, 0]
    assert_allclose(gains, REFERENCE[name], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "name"),
    [
        (LQR(**WEIGHTS, feedback=FEW, design=DESIGN), "time_invariant"),
        (FiniteLQR(**WEIGHTS, feedback=FEW, design=DESIGN), "finite_time"),
        (AugmentedLQR(**WEIGHTS, feedback=FEW, design=DESIGN), "augmented"),
    ],
)
def test_closed_loops(controller, name):
    expected = REFERENCE[f"continuous_closed_loop_{name}"]
    record = jb.simulate(rig(controller, 2.5), times=jnp.array([0.0, *expected["time_s"]]))
    peak = expected["largest_abs_deflection"]
    found = record.deflection[1:, 0]
    assert_allclose(found, expected["deflection_at_0p25_m"], rtol=0, atol=1e-6 * peak)
    most = np.max(np.abs(expected["voltage"]))
    assert_allclose(record.command[1:, 0], expected["voltage"], rtol=0, atol=1e-6 * most)
    assert_allclose(jnp.max(jnp.abs(record.peak_deflection)), peak, rtol=1e-6)
