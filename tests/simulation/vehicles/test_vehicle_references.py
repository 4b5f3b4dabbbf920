"""Vehicles and trains against runs of an independent implementation (`tests/data`).

Deflections with the static correction to 1e-5 of the peak, contact forces to 1e-5 of the static
load; of rigid wheelsets on a rough rail, where all modes matter, to 2e-4, as its report states.
Heights of bodies follow the beam without the correction: to 2e-4 of the largest with 16 modes
(1e-6 with 40), accelerations to 3e-3 between samples.
"""

import numpy as np
import pytest

import jaxbeam as jb
from tests.simulation.vehicles.reference_vehicles import (
    DATA,
    RUNS,
    body_index,
    largest,
    simulated,
)

# Others have 16. The two spans have the 40 of the reference, without the correction: it misses
# 2.5e-5 of those beyond, as it states.
MODES = {"1d-oscillator-two-span": 40, "2k-fra6-wagon-ss25": 30}
SAMPLES = {
    "1d-oscillator-two-span": 151,
    "2h-isoA-quarter-ss": 1301,
    "1p-train-4-manchester-ss50": 601,
}  # axles on a rough road


@pytest.mark.parametrize("name", RUNS)
def test_runs_are_those_of_the_reference(name):
    run = RUNS[name]
    record, at = simulated(run, MODES.get(name, 16), SAMPLES.get(name, 301))
    deflection, peaks = record.deflection, record.peak_deflection
    if MODES.get(name) != 40:
        deflection = jb.sections.corrected_deflection(record, record.case.sensor_positions)
        peaks = [largest(-history) for history in deflection.T]
    for i, expected in enumerate(run["deflection"].values()):
        found = deflection[[at(share * run["duration"]) for share in run["fractions"]], i]
        scale = abs(expected["w_min"])
        np.testing.assert_allclose(found, expected["w_at_fractions"], rtol=0, atol=1e-5 * scale)
        assert peaks[i] == pytest.approx(scale, rel=2e-5)
    tolerance = 2e-4 if name.startswith("2k") else 1e-5
    for wheel in run["contact"]:
        force = record.contact_force[:, wheel["wheel"]]
        for extreme in ("min", "max"):
            found = force[at(wheel[f"t_{extreme}"])]
            assert found == pytest.approx(wheel[f"F_{extreme}"], abs=tolerance * wheel["static"])
    for body in run["bodies"]:
        column, sign = body_index(record, run, body)
        motion = sign * record.body_displacement[:, column]
        scale = max(body["u_max"], -body["u_min"])
        assert motion[-1] == pytest.approx(body["u_end"], abs=2e-4 * scale)
        extremes = -largest(-motion), largest(motion)
        np.testing.assert_allclose(extremes, [body["u_min"], body["u_max"]], atol=2e-4 * scale)
        motion = sign * record.body_acceleration[:, column]
        expected = np.array([body["acc_min"], body["acc_max"]])
        extremes = -largest(-motion), largest(motion)
        np.testing.assert_allclose(extremes, expected, atol=3e-3 * np.max(np.abs(expected)))


@pytest.mark.parametrize("entry", DATA["trains"], ids=lambda entry: entry["train"])
def test_high_speed_trains_at_two_speeds(entry):
    """Lowest deflection at midspan; 15 modes without a correction for 20 with it."""
    for speed, expected in zip(np.array(entry["speeds_kmh"]) / 3.6, entry["w_min"], strict=True):
        load = jb.Axles(train=entry["train"], speed=speed)
        length = load.vehicle(np.float64(9.81)).offsets[-1] + 25.0
        case = jb.Case(
            jb.Beam(25.0, 3e10, 15e3, 0.01, modes=15),
            sensors=[jb.Sensor(12.5)],
            loads=[load],
            run=jb.Run(length / speed + 0.5, 200.0),
        )
        record = jb.simulate(case)
        assert record.peak_deflection[0] == pytest.approx(-expected, rel=1e-5)
        assert np.all(np.isfinite(record.contact_force))
