"""Sweeps in single precision and on several devices: the same results, to rounding."""

import dataclasses
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from experiments.benchmarks.common import without_native
from jaxbeam.sweeps import blocks, integration

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3),
    supports=[jb.Support(0.25, stiffness=2e4, damping=3.0)],  # modes coupled by a damper
    actuators=[jb.PointForce(0.3)],
    sensors=[jb.Sensor(0.15), jb.Sensor(0.4)],
    loads=[jb.MovingMass(mass=0.3, speed=1.0), jb.MovingForce(force=2.0, speed=2.0)],
    run=jb.Run(0.5, sample_rate=200.0),
)
OVER = {
    "loads.0.mass": np.linspace(0.1, 1.0, 5),
    "loads.0.speed": np.geomspace(1.0, 10.0, 4),
    "beam.flexural_rigidity": [10.0, 12.0],
}


def test_single_precision_meets_its_error_estimate():
    double, single = (
        jb.sweep(CASE, OVER, progress=False, precision=word) for word in ("double", "single")
    )
    assert single.peak_deflection.dtype == np.float32
    assert double.peak_deflection.dtype == np.float64
    error = np.max(np.abs(single.peak_deflection / double.peak_deflection - 1))
    assert 1e-8 < error < 2e-5  # some tens of roundings, 6e-8 each
    assert float(error) < 5 * single.error_estimate  # measured on a sample of the runs
    assert not single.failed.any()
    with_histories = jb.sweep(CASE, OVER, progress=False, precision="single", histories=True)
    assert with_histories.deflection.dtype == np.float32
    assert_allclose(
        np.abs(with_histories.deflection).max("time") <= double.peak_deflection * 1.00002, True
    )


@pytest.mark.parametrize("option", ["double", "single", "histories"])
def test_batches_at_once_as_on_accelerators(monkeypatch, option):
    options = {"histories": True} if option == "histories" else {"precision": option}
    expected = jb.sweep(CASE, OVER, progress=False, **options)
    for module in (blocks, integration):
        monkeypatch.setattr(module, "in_sequence", lambda: False)
    jax.clear_caches()
    with without_native():
        found = jb.sweep(CASE, OVER, progress=False, **options)
    tolerance = 2e-5 if option == "single" else 1e-10
    assert_allclose(found.peak_deflection, expected.peak_deflection, rtol=tolerance)
    if option == "histories":
        assert_allclose(found.deflection, expected.deflection, rtol=1e-9, atol=1e-16)


def test_unknown_precisions_are_refused():
    with pytest.raises(ValueError, match="precision must be double or single, not 'half'"):
        jb.sweep(CASE, OVER, precision="half")
    controlled = dataclasses.replace(CASE, controller=jb.Feedback(gains=[100.0], period=0.01))
    with pytest.raises(ValueError, match="controllers need double precision"):
        jb.sweep(controlled, OVER, precision="single")


SHARED = """
import sys
import jax
import numpy as np
import jaxbeam as jb
from tests.sweeps.test_devices import CASE, OVER
assert len(jax.local_devices()) == 3
peaks = jb.sweep(CASE, OVER, progress=False).peak_deflection.values
lines = jb.sweep(CASE, OVER, progress=False, histories=True).deflection.values
np.savez(sys.argv[1], peaks=peaks, lines=lines)
"""


def test_several_devices_share_a_block(tmp_path):
    """Three devices and eight batches, which three does not divide."""
    flags = os.environ["XLA_FLAGS"] + " --xla_force_host_platform_device_count=3"
    command = [sys.executable, "-c", SHARED, str(tmp_path / "shared.npz")]
    subprocess.run(
        command, env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}, check=True
    )
    one_device = jb.sweep(CASE, OVER, progress=False, histories=True)
    with np.load(tmp_path / "shared.npz") as shared:
        assert_allclose(shared["lines"], one_device.deflection, rtol=1e-9, atol=1e-16)
        assert_allclose(
            shared["peaks"], jb.sweep(CASE, OVER, progress=False).peak_deflection, rtol=1e-12
        )
