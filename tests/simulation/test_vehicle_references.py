"""Vehicles and trains against runs of an independent implementation (`tests/data`).

Deflections to 1e-5 of the peak, contact forces to 1e-5 of the static load, heights of bodies to
2e-5 of the largest, accelerations to 1e-3 or what the reference states (its samples are coarse).
"""

import numpy as np
import pytest

import jaxbeam as jb
from tests.simulation.reference_vehicles import (
    DATA,
    RUNS,
    WAVES,
    body_index,
    case_of,
    largest,
    simulated,
)

# Modes with which the deflection at midspan has converged; two spans need those of the reference.
MODES = {"1d-oscillator-two-span": 40}
SLOW = ("1l-artic-5-axle-ss-vbi2d-default", "1p-train-4-manchester-ss50", "2k-fra6-wagon-ss25")
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name
    for name in RUNS
]


@pytest.mark.parametrize("name", NAMES)
def test_runs_are_those_of_the_reference(name):
    run = RUNS[name]
    record, at = simulated(run, MODES.get(name, 32), 601)
    for i, expected in enumerate(run["deflection"].values()):
        found = record.deflection[[at(share * run["duration"]) for share in run["fractions"]], i]
        scale = abs(expected["w_min"])
        np.testing.assert_allclose(found, expected["w_at_fractions"], rtol=0, atol=1e-5 * scale)
        assert record.peak_deflection[i] == pytest.approx(scale, rel=1e-5)
    for wheel in run["contact"]:
        force = record.contact_force[:, wheel["wheel"]]
        for extreme in ("min", "max"):
            found = force[at(wheel[f"t_{extreme}"])]
            assert found == pytest.approx(wheel[f"F_{extreme}"], abs=1e-5 * wheel["static"])
    for body in run["bodies"]:
        column, sign = body_index(record, run, body)
        motion = sign * record.body_displacement[:, column]
        scale = max(body["u_max"], -body["u_min"])
        assert motion[-1] == pytest.approx(body["u_end"], abs=1e-5 * scale)
        extremes = -largest(-motion), largest(motion)
        np.testing.assert_allclose(extremes, [body["u_min"], body["u_max"]], atol=2e-5 * scale)
        motion = sign * record.body_acceleration[:, column]
        expected = np.array([body["acc_min"], body["acc_max"]])
        extremes = -largest(-motion), largest(motion)
        np.testing.assert_allclose(extremes, expected, atol=1e-3 * np.max(np.abs(expected)))
