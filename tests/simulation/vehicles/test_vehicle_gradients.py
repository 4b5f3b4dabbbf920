"""Derivatives of a run of a quarter car by every number of it and of the profile, by differences.

And runs in a sweep and under control, against single ones and those of traced numbers.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import integration_plan
from tests.differences import assert_close, plan_of

TIMES = np.linspace(0.0, 1.4, 57)
CAR = {
    "body_mass": 14000.0,
    "axle_mass": 1100.0,
    "suspension_stiffness": 9e5,
    "suspension_damping": 3e4,
    "tyre_stiffness": 3e6,
    "tyre_damping": 8e3,
}
CASE = jb.Case(
    jb.Beam(20.0, 2e10, 1.2e4, 0.02, modes=2),
    sensors=[jb.Sensor(7.0)],
    loads=[jb.QuarterCar(**CAR, speed=20.0, start_position=-5.0, deceleration=1.0)],
    profile=jb.profiles.BumpProfile(-4.0, 3.0, 0.02),
    run=jb.Run(1.4, 40.0),
)
NUMBERS = [f"loads.0.{name}" for name in (*CAR, "speed", "deceleration", "start_position")]
NUMBERS += ["profile.height", "profile.start", "profile.end", "run.gravity"]


def summary(record: jb.Record):
    """Numbers of order one of a record."""
    return jnp.concatenate(
        [
            1e3 * record.deflection[1::4, 0],
            1e-5 * record.contact_force[1::4, 0],
            1e2 * record.body_displacement[1::4].ravel(),
            1e-1 * record.body_acceleration[1::4].ravel(),
            1e3 * record.peak_deflection,
        ]
    )


def of_factors(case, numbers, plan):
    """Function from factors of numbers to the summary of a run with them."""
    values = {address: jb.addresses(case)[address] for address in numbers}

    def function(factors):
        changed = {a: f * v for f, (a, v) in zip(factors, values.items(), strict=True)}
        return summary(jb.simulate(jb.replace(case, changed), TIMES, plan))

    return function


def test_reverse_gradients_by_every_number():
    function = of_factors(CASE, NUMBERS, plan_of(CASE, substeps=6))
    point = np.ones(len(NUMBERS))
    weights = np.cos(np.arange(function(point).size))
    forward, reverse = (
        jax.jit(derivative(lambda factors: weights @ function(factors)))(jnp.asarray(point))
        for derivative in (jax.jacfwd, jax.jacrev)
    )
    assert_allclose(reverse, forward, rtol=1e-8, atol=1e-8 * np.max(np.abs(forward)))


def test_a_plan_serves_traced_numbers():
    """One that `integration_plan` makes, inside `jit`."""
    plan = integration_plan(CASE, TIMES)
    function = of_factors(CASE, NUMBERS, plan)
    known = function(np.ones(len(NUMBERS)))
    traced = jax.jit(function)(jnp.ones(len(NUMBERS)))
    assert_close(traced, known, 1e-10)


SWEEPS = {
    "numbers of the vehicle": {
        "loads.0.suspension_stiffness": [6e5, 1.2e6],
        "loads.0.body_mass": [1e4, 2e4],
    },
    "speeds": {"loads.0.speed": [18.0, 25.0], "loads.0.tyre_damping": [0.0, 2e4]},
    "the profile": {"profile.height": [0.0, 0.03]},
}


@pytest.mark.parametrize("name", SWEEPS)
def test_sweeps_are_single_runs(name):
    over = SWEEPS[name]
    found = jb.sweep(CASE, over, progress=False)
    assert not found.failed.any()
    for index in np.ndindex(*(len(values) for values in over.values())):
        chosen = {a: values[i] for i, (a, values) in zip(index, over.items(), strict=True)}
        single = jb.simulate(jb.replace(CASE, chosen))
        peaks = found.peak_deflection.values[index]
        assert_allclose(peaks, single.peak_deflection, rtol=1e-6)


FORCE = jb.PointForce(9.0)
LOOPS = {
    "sampled feedback": ([jb.Sensor(7.0, "velocity")], jb.Feedback([2e5], period=0.01)),
    "continuous feedback": ([jb.Sensor(7.0, "velocity")], jb.Feedback([2e5])),
    "regulator": ([jb.Sensor(7.0)], jb.LQR([0.1] * 4, [1e-9], period=5e-3)),
}


@pytest.mark.parametrize("name", LOOPS)
def test_closed_loops_with_a_vehicle(name):
    sensors, controller = LOOPS[name]
    case = dataclasses.replace(
        CASE, sensors=sensors, actuators=[FORCE], controller=controller, run=jb.Run(1.4, 40.0)
    )
    plan = integration_plan(case, TIMES)
    known = jb.simulate(case, TIMES, plan)
    open_loop = jb.simulate(dataclasses.replace(case, actuators=(), controller=None), TIMES)
    assert known.peak_deflection[0] < open_loop.peak_deflection[0]
    assert np.max(np.abs(known.command)) > 0
    traced = jax.jit(lambda factor: _with_mass(case, factor, plan))(jnp.ones(()))
    for one, other in zip(traced, _with_mass(case, np.ones(()), plan), strict=True):
        assert_close(one, other, 1e-9)


def _with_mass(case, factor, plan):
    changed = jb.replace(case, {"loads.0.body_mass": factor * CAR["body_mass"]})
    record = jb.simulate(changed, TIMES, plan)
    return record.deflection, record.command, record.contact_force, record.body_acceleration
