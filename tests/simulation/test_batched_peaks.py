"""Gradients of the peaks of a batch of runs, as the how-to on gradients takes them."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.integration_plan import integration_plan
from tests.differences import central

TIMES = np.array([0.0, 0.17, 0.3])  # s; no wheel passes a sensor or an end then
SPEEDS = jnp.array([2.5, 4.0])  # m/s
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.25), jb.Sensor(0.25, "moment"), jb.Sensor(0.25, "acceleration")],
    loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    run=jb.Run(0.3),
)
NUMBERS = {"loads.0.mass": 0.4, "beam.flexural_rigidity": 11.68, "sensors.*.position": 0.25}


def test_gradients_of_peaks_of_a_batch():
    """Peaks between samples of deflection, statically corrected moment and acceleration."""
    plan, sizes = integration_plan(CASE, TIMES), np.array(list(NUMBERS.values()))

    def peaks(shares, speed):
        numbers = dict(zip(NUMBERS, shares * sizes, strict=True)) | {"loads.0.speed": speed}
        record = jb.simulate(jb.replace(CASE, numbers), TIMES, plan)
        return xp.maximum(record.largest, -record.smallest)

    def single_runs(shares):
        return np.stack([peaks(shares, speed) for speed in np.asarray(SPEEDS)])

    ones, batch = np.ones(sizes.size), jax.vmap(peaks, in_axes=(None, 0))
    found = jax.jit(jax.jacfwd(batch))(jnp.asarray(ones), jnp.asarray(SPEEDS))
    expected, scale = central(single_runs, ones, step=1e-4), np.abs(single_runs(ones))[..., None]
    assert_allclose(found / scale, expected / scale, rtol=1e-5, atol=1e-7)
