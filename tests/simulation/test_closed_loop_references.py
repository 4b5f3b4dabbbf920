"""Closed loops against numbers of the reference implementation."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from tests.modules import DATA
from tests.simulation.test_closed_loop import loop, run

REFERENCE = json.loads((DATA / "reference_control.json").read_text())


def reference_case(name: str) -> jb.Case:
    """Rig A under its time-invariant gain; rig B under constant voltage or feedback."""
    reference = REFERENCE[name]
    if name == "time-invariant gain":
        beam = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3)
        shaker = jb.Shaker(0.5, stiffness=12000.0, damping=80.0, force_per_volt=2.5, bandwidth=1e4)
        # The gain is for amplitudes of sines, the states are mass-normalised.
        scale = np.full(6, np.sqrt(2 / (0.535 * 0.6)))
        gain = np.array(reference["gain"]) * np.array(reference["used"]) * np.append(scale, 1.0)
        law, sensor, duration = jb.StateFeedback(gain[None]), jb.Sensor(0.25), 1.5
        return loop([shaker], [sensor], law, beam, [jb.MovingMass(0.509, 0.55)], duration)
    beam = jb.Beam(0.6, 13.211, 0.812, 0.03, modes=5)
    patch = jb.Patch(0.2575, 0.3425, reference["moment_per_volt"], amplifier_gain=200.0)
    filter = None
    if name == "constant voltage":
        law = jb.Prescribed([7.5])
    elif name == "linear law":
        law = jb.Feedback([2e3])
    else:
        law, filter = jb.Feedback([2e9], 3), jb.Filter(10.0, 10, realisation="analogue")
    load = jb.MovingMass(reference["mass"], reference["speed"])
    return loop([patch], [jb.Sensor(0.3, filter=filter)], law, beam, [load], 1.21)


@pytest.mark.parametrize("name", REFERENCE)
def test_reference_numbers(name):
    reference = REFERENCE[name]
    times = np.append(0.0, reference["time_s"])
    if "sampled_every_s" in reference:
        times = reference["sampled_every_s"] * np.arange(501)
    record = run(reference_case(name), times, reference["substeps"])
    at = np.searchsorted(times, np.array(reference["time_s"]) - 1e-9)
    for found, true in (
        (record.deflection[at, 0], reference["deflection_m"]),
        (record.command[at, 0], reference["command"]),
    ):
        assert_allclose(found, true, rtol=0, atol=1e-8 * np.max(np.abs(true)))
    if "sampled_every_s" in reference:
        largest = np.max(np.abs(record.deflection))
        assert_allclose(largest, reference["largest_sampled_deflection_m"], rtol=1e-8)
    else:
        assert_allclose(record.peak_deflection[0], reference["largest_deflection_m"], rtol=1e-8)
