"""Closed loops: records, divergence, batches and derivatives."""

import dataclasses
import json
import logging
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from jaxbeam.sweeps.quality import FailedRunsWarning
from tests.differences import central
from tests.loop_as_oracle import expected

BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2)
MASS = jb.MovingMass(mass=0.4, speed=2.5)
TIMES = np.linspace(0.0, 0.3, 31)
HELD = jb.Case(
    BEAM,
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0, limits=[-0.3, 0.35])],
    sensors=[jb.Sensor(0.25, filter=jb.Filter(60.0, 3))],
    loads=[MASS],
    controller=jb.Feedback([600.0], period=2e-3, delay=5e-4),
    run=jb.Run(0.3, sample_rate=100.0),
    title="a loop",
)


def plan_for(case: jb.Case, times=TIMES, substeps: int = 1) -> IntegrationPlan:
    return IntegrationPlan(
        static_shapes(case), substeps, 0, False, 0.0, loop_schedule(case, np.asarray(times))
    )


@pytest.fixture(scope="module")
def plan():
    return plan_for(HELD)


@pytest.fixture(scope="module")
def record(plan):
    return jb.simulate(HELD, TIMES, plan)


def test_record_of_command_saturation_and_effort(record):
    truth = expected(HELD, TIMES).command
    assert_allclose(record.command, truth, rtol=0, atol=1e-10)
    assert_array_equal(record.saturated, truth == 0.35)
    assert 0 < np.sum(record.saturated) < TIMES.size
    assert_allclose(record.effort, np.trapezoid(truth**2, TIMES, axis=0), rtol=1e-9)
    assert np.isnan(record.diverged_time)
    assert record.verdict.startswith("every load presses on the beam throughout")


def test_record_with_a_controller_in_a_file(record, tmp_path):
    record.to_netcdf(tmp_path / "loop.nc")
    restored = jb.read_record(tmp_path / "loop.nc")
    assert jax.tree.structure(restored) == jax.tree.structure(record)
    jax.tree.map(assert_array_equal, restored, record)
    dataset = record.to_xarray()
    assert dataset.command.dims == ("time", "actuator")
    assert json.loads(dataset.attrs["case"])["controller"]["gains"] == [600.0]


# Divergence

UNBOUNDED = dataclasses.replace(HELD, actuators=(jb.PointForce(0.3),), sensors=(jb.Sensor(0.25),))
GAINS, MASSES = np.array([100.0, 1e5, 700.0]), np.array([0.1, 0.4])


def test_verdict_of_a_diverging_loop():
    """No exception and no warning."""
    record = jb.simulate(jb.replace(UNBOUNDED, {"controller.gains.0": 1e5}))
    diverged = float(record.diverged_time)
    assert 0 < diverged < 0.3
    growth = f"the deflection has grown beyond all bounds by t = {diverged:.4g}"
    assert f"the control loop diverges: {growth}" in record.verdict
    before = np.asarray(record.times) < diverged
    assert np.all(np.isfinite(record.deflection[before]))
    assert np.all(np.isnan(record.deflection[~before]))
    assert np.isnan(record.peak_deflection).all() and np.isnan(record.error_estimate)


@pytest.fixture(scope="module")
def sweep_and_compilations():
    """Sweep over gains, one of which diverges, and masses; and the programs compiled for it."""
    messages = []

    class MessageRecorder(logging.Handler):
        def emit(self, record):
            messages.append(record.getMessage())

    logger, handler = logging.getLogger("jax"), MessageRecorder()
    logger.addHandler(handler)
    jax.config.update("jax_log_compiles", True)  # in all threads; its context is for one
    try:
        over = {"controller.gains.0": GAINS, "loads.0.mass": MASSES}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FailedRunsWarning)
            dataset = jb.sweep(UNBOUNDED, over, progress=False)
    finally:
        jax.config.update("jax_log_compiles", False)
        logger.removeHandler(handler)
    return dataset, [message for message in messages if "Compiling jit(integrate_block" in message]


def test_only_diverging_runs_of_a_sweep_fail(sweep_and_compilations):
    dataset, compilations = sweep_and_compilations
    assert dataset.attrs["failed_runs"] == 2
    assert_array_equal(dataset.failed, [[False, False], [True, True], [False, False]])
    assert np.isnan(dataset.peak_deflection[1]).all()
    assert not compilations  # a small sweep takes its steps in NumPy
    plan = plan_for(UNBOUNDED)
    for i in (0, 2):
        for j in range(2):
            values = {"controller.gains.0": GAINS[i], "loads.0.mass": MASSES[j]}
            single_run = jb.simulate(jb.replace(UNBOUNDED, values), TIMES, plan)
            assert_allclose(dataset.peak_deflection[i, j], single_run.peak_deflection, rtol=1e-7)


def test_batch_of_gains_equals_single_runs():
    plan = plan_for(UNBOUNDED)

    def deflection(gain):
        case = jb.replace(UNBOUNDED, {"controller.gains.0": gain})
        return jb.simulate(case, TIMES, plan).deflection

    batched = jax.jit(jax.vmap(deflection))(jnp.asarray(GAINS))
    for gain, found in zip(GAINS, batched, strict=True):
        # Rounding grows where the loop diverges.
        assert_allclose(found, deflection(gain), rtol=1e-12 if gain < 1e4 else 1e-6, atol=1e-15)
    assert np.isnan(batched[1]).any() and np.isfinite(batched[np.array([0, 2])]).all()


# Derivatives

FREE = {
    "controller.gains.0": 600.0,
    "sensors.0.filter.cutoff": 60.0,
    "actuators.0.force_per_volt": 4.6,
    "actuators.0.stiffness": 500.0,
    "actuators.0.damping": 8.0,
    "actuators.0.bandwidth": 400.0,
    "actuators.0.limits.1": 0.35,
    "loads.0.mass": 0.4,
    "loads.0.speed": 2.5,
}


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_gradients_through_filter_hold_delay_and_saturation(plan, record, derivative):
    sizes = np.array(list(FREE.values()))
    data = record.deflection + 2e-4 * np.cos(np.arange(31.0))[:, None]

    def outputs(point):
        case = jb.replace(HELD, dict(zip(FREE, point * sizes, strict=True)))
        found = jb.simulate(case, TIMES, plan)
        misfit = xp.sum(((found.deflection - data) / 1e-3) ** 2)
        return xp.stack([misfit, found.peak_deflection[0] * 1e3, found.effort[0]])

    at = jnp.ones(len(FREE))
    differences = central(outputs, np.ones(len(FREE)), step=2e-4, order=4)
    size = np.max(np.abs(differences), axis=1, keepdims=True)
    assert np.all(np.abs(differences[0]) > 1e-4 * size[0])
    found = jax.jit(derivative(outputs))(at)
    assert_allclose(found / size, differences / size, rtol=1e-6, atol=1e-8)


LAW = dataclasses.replace(
    HELD,
    actuators=(jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0),),
    sensors=(jb.Sensor(0.25, filter=jb.Filter(30.0, 3, realisation="analogue")),),
    controller=jb.Feedback([3e8], power=3),
)


def test_gradients_of_a_law_in_continuous_time():
    names = ("controller.gains.0", "sensors.0.filter.cutoff", "actuators.0.damping", "loads.0.mass")
    sizes = np.array([float(jb.addresses(LAW)[name]) for name in names])
    plan = plan_for(LAW, substeps=2)

    def outputs(point):
        case = jb.replace(LAW, dict(zip(names, point * sizes, strict=True)))
        found = jb.simulate(case, TIMES, plan)
        return xp.stack([xp.sum((found.deflection * 1e3) ** 2), found.effort[0]])

    differences = central(outputs, np.ones(len(names)), step=2e-3, order=6)
    gradients = jax.jit(jax.jacrev(outputs))(jnp.ones(len(names)))
    assert_allclose(gradients, differences, rtol=1e-6)
