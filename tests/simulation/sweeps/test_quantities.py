"""Peaks of every quantity in sweeps, and of high-speed trains: single runs, references.

Peaks (mm) of trains at midspan of 25 m are those of `trains.json`, cases 3a: 20 modes, exact
recursion on instants 0.0125 m of travel apart, static correction. Nine modes leave out at most
96 / pi^4 (1/11^4 + 1/13^4 + ...) = 1.4e-4 of the static deflection under a force at midspan; even
modes do not move it.
"""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.files.case_file import load_case, with_settings
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import sensor_rows
from jaxbeam.simulation.errors import MAX_SAMPLES
from jaxbeam.simulation.integrator.discrete_model import bounds_by_energy, energies
from jaxbeam.simulation.integrator.step_size import (
    longest_stable_step,
    trial_run,
    without_later_vibration,
)
from jaxbeam.simulation.sweeps.computation import SAMPLES, TruncationWarning
from tests.modules import ROOT

BEAM = jb.Beam(1.2, 11.68, 0.535, 0.02, modes=3)
FOLLOWED = (
    *("deflection", "velocity", "acceleration", "slope", "curvature", "strain", "moment"),
    "shear",
)
SENSORS = tuple(
    jb.Sensor(0.45, name, fibre_distance=2e-3 if name == "strain" else None) for name in FOLLOWED
)
CASES = {
    "force": jb.Case(
        BEAM,
        sensors=SENSORS,
        loads=[jb.MovingForce(force=3.0, speed=4.0)],
        run=jb.Run(0.4, sample_rate=20000.0),
    ),
    "masses": jb.Case(
        BEAM,
        supports=[jb.Support(0.7, stiffness=3e3, damping=2.0)],
        sensors=SENSORS,
        loads=[
            jb.MovingMass(mass=0.3, speed=4.0),
            jb.MovingMass(mass=0.2, speed=-3.0, entry_time=0.1),
        ],
        run=jb.Run(0.5, sample_rate=20000.0),
    ),
    "Timoshenko": jb.Case(
        dataclasses.replace(BEAM, shear_stiffness=4e3),
        sensors=SENSORS,
        loads=[jb.MovingForce(force=3.0, speed=4.0)],
        run=jb.Run(0.4, sample_rate=20000.0),
    ),
    "command": jb.Case(  # of two modes, so that fewer samples suffice
        dataclasses.replace(BEAM, modes=2),
        actuators=[jb.Patch(0.4, 0.5, 2e-3, limits=[-200, 200])],
        controller=jb.Feedback(gains=[2e4], period=0.002),
        sensors=[jb.Sensor(0.45), jb.Sensor(0.3, "acceleration"), jb.Sensor(0.3, "velocity")],
        loads=[jb.MovingForce(force=3.0, speed=4.0)],
        run=jb.Run(0.35, sample_rate=8000.0),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_peaks_of_each_quantity(name):
    """Samples at 20 kHz miss a peak by less than 1e-4 of it."""
    case = CASES[name]
    found = jb.sweep(case, {"loads.0.speed": [3.0, 4.0]}, progress=False)
    assert found.attrs["error_estimate"] < 1e-7
    record = jb.simulate(case)
    for i, sensor in enumerate(case.sensors):
        peaks = found[f"peak_{sensor.quantity}"]
        assert peaks.attrs["units"] == sensor.unit
        history = np.asarray(record.sensor_values[:, i])
        expected = np.abs(history).max()
        assert_allclose(peaks[1, i], expected, rtol=1e-4, err_msg=sensor.quantity)
        assert float(peaks[1, i]) >= expected * (1 - 1e-7)
        when = np.abs(history).argmax()
        assert_allclose(found["peak_time"][1, i], record.times[when], atol=1e-4)
        others = [j for j, other in enumerate(case.sensors) if other.quantity != sensor.quantity]
        assert np.isnan(peaks[:, others]).all()


def test_stated_truncation_is_that_of_a_run_with_short_steps():
    """Sweeps estimate it with the longest stable step."""
    sensors = (jb.Sensor(0.5, "moment"), jb.Sensor(0.3, "acceleration"))
    case = dataclasses.replace(CASES["masses"], sensors=sensors)
    speed = float(case.loads[0].speed)
    found = jb.sweep(case, {"loads.0.speed": [speed]}, progress=False)
    model, loads = modal_model(case), load_set(case)
    case = without_later_vibration(case, model, load_set(case))
    longest = float(longest_stable_step(case, model, loads))
    step = min(float(case.run.duration) / SAMPLES, longest)
    times = np.unique(trial_run(case, model, loads, 2, step)[0])
    assert times.size <= MAX_SAMPLES
    record = jb.simulate(case, times, tolerance=1e-8)
    changes = record.truncation_errors * np.abs(record.sensor_values).max(axis=0)
    for i, name in enumerate(("moment", "acceleration")):
        peaks = found[f"peak_{name}"]
        assert_allclose(peaks.attrs["truncation_error"] * peaks[0, i], changes[i], rtol=1e-2)


def test_peaks_under_a_slow_axle_are_the_static_ones():
    """P L / 4 at midspan and P x / L left of x; three modes miss 9.9 % of the moment."""
    assert round(100 * (1 - 8 / np.pi**2 * (1 + 1 / 9)), 1) == 9.9
    sensors = (jb.Sensor(0.6, "moment"), jb.Sensor(0.3, "shear"))
    case = dataclasses.replace(CASES["force"], sensors=sensors, run=jb.Run(60.0, sample_rate=10.0))
    found = jb.sweep(case, {"loads.0.speed": [0.02]}, progress=False)
    assert_allclose(found["peak_moment"][0, 0], 3.0 * 1.2 / 4, rtol=3e-3)
    assert_allclose(found["peak_shear"][0, 1], 3.0 * 0.75, rtol=1e-2)
    assert found["peak_moment"].attrs["long_name"].endswith("moment, statically corrected")
    assert 0 < found["peak_moment"].attrs["truncation_error"] < 0.01


def test_moments_of_a_high_speed_train_converge_to_those_of_an_independent_program():
    """Case 3c of `trains.json`: HSLM-A1 at 230 km/h, 160 modes, corrected."""
    case = load_case(ROOT / "examples" / "railway_bridge" / "case.toml")
    case = with_settings(case, {"loads.0.train": "HSLM-A1", "run.duration": 8.0, "beam.modes": 3})
    case = dataclasses.replace(case, sensors=(jb.Sensor(12.5, "moment"),))
    found = jb.sweep(case, {"loads.0.speed": [230 / 3.6]}, progress=False)
    # The reference with three modes, on instants 0.0125 m of travel apart; then all modes.
    assert_allclose(found["peak_moment"][0, 0], 8496874.08, rtol=1e-6)
    assert_allclose(found["peak_moment"][0, 0], 8497709.91, rtol=2e-4)


def test_moments_of_a_moving_mass_against_an_independent_program():
    """Case 4a of `sections.json`: 80 modes, extrapolated; ten modes with the static correction.

    Its own two methods agree to 3.5e-5 of the largest moment. Single precision differs by rounding.
    """
    data = json.loads((ROOT / "tests" / "data" / "sections.json").read_text())["cases"]
    reference = next(case for case in data if case["case"].startswith("4a"))
    parameters = reference["parameters"]
    speed, mass, weight = (parameters[name] for name in ("speed", "mass", "weight"))
    case = jb.Case(
        jb.Beam(1.0, 1.0, 1.0, 0.03, modes=10),
        sensors=[jb.Sensor(x, "moment") for x in parameters["xs"]],
        loads=[jb.MovingMass(mass=mass, speed=speed)],
        run=jb.Run(1 / speed, sample_rate=50.0, gravity=weight / mass),
    )
    found = jb.sweep(case, {"loads.0.speed": [speed]}, progress=False)["peak_moment"][0]
    expected = [reference["outputs"][f"M_{x:g}"]["max"] for x in parameters["xs"]]
    assert_allclose(found, expected, rtol=1e-3)
    over = {"loads.0.speed": [speed]}
    single = jb.sweep(case, over, progress=False, precision="single")["peak_moment"][0]
    assert single.dtype == np.float32
    assert_allclose(single, found, rtol=1e-4)


@pytest.mark.filterwarnings("ignore::jaxbeam.model.plausibility.check.PlausibilityWarning")
def test_beams_that_can_move_as_a_rigid_body_are_not_corrected():
    free = dataclasses.replace(BEAM, ends="free-free")
    sensors = (jb.Sensor(0.6, "moment"), jb.Sensor(0.6, "shear"))
    case = dataclasses.replace(CASES["force"], beam=free, sensors=sensors[:1])
    with pytest.warns(TruncationWarning, match=r"sensors.0 \(moment\) are sums of 3 modes"):
        found = jb.sweep(case, {"loads.0.force": [3.0]}, progress=False)
    assert found["peak_moment"].attrs["long_name"] == "largest absolute moment, sum of 3 modes"
    case = dataclasses.replace(case, sensors=sensors)
    with pytest.raises(ValueError, match=r"sensors.1 measures shear, whose sum of modes converges"):
        jb.sweep(case, {"loads.0.force": [3.0]}, progress=False)


@pytest.mark.parametrize("coupled", [True, False])
def test_free_outputs_are_bounded_by_the_energies_of_the_blocks(coupled):
    case = CASES["masses" if coupled else "force"]
    model = modal_model(case, full_matrix=coupled)
    rows = sensor_rows(model, case, SENSORS[:-1])
    bounds = bounds_by_energy(model, rows)
    assert bounds.shape == (len(SENSORS) - 1, 1 if coupled else case.beam.modes)
    C, _ = rows.of_system(model, model.A, np.zeros((model.state_count, 0)))
    states = np.random.default_rng(1).normal(size=(model.state_count, 4000))
    states[model.coordinate_index] /= model.modes.angular_frequencies[:, None]
    found = energies(model, states)
    q, rates = states[model.coordinate_index], states[model.rate_index]
    whole = np.sum(rates**2, axis=0) + np.sum(q * (model.stiffness() @ q), axis=0)
    assert_allclose(found.sum(axis=0), whole, rtol=1e-12)
    share = np.abs(C @ states) / (bounds @ np.sqrt(found))
    assert np.all(share <= 1) and np.all(share.max(axis=1) > 0.45)


def test_supports_have_no_truncation_error():
    """Of the midspan: 1 - 96 / pi^4 (1 + 1 / 81) for three modes; sums at supports are zero."""
    case = jb.Case(
        jb.Beam(20.0, 6e9, 9e3, modes=3),
        sensors=[jb.Sensor(0.0), jb.Sensor(10.0), jb.Sensor(20.0)],
        loads=[jb.MovingForce(force=1e5, speed=20.0)],
    )
    found = jb.sweep(case, {"loads.0.speed": [10.0, 20.0]}, progress=False)["peak_deflection"]
    expected = 1 - 96 / np.pi**4 * (1 + 1 / 81)
    assert found.attrs["truncation_error"] == pytest.approx(expected, rel=1e-9)
    case = dataclasses.replace(case, run=jb.Run(1.0, sample_rate=100.0))
    record = jb.simulate(case)
    errors, static = record.truncation_errors, 1e5 * 20.0**3 / (48 * 6e9)
    assert errors[0] == errors[2] == 0.0
    missed = errors[1] * np.max(np.abs(record.sensor_values[:, 1]))
    assert missed == pytest.approx(expected * static, rel=1e-3)


CASE = load_case(ROOT / "examples" / "railway_bridge" / "case.toml")
SPEEDS = np.array([165.0, 230.0, 307.5, 332.5])  # km/h
PEAKS = {
    "HSLM-A1": [7.449978, 17.82763, 8.37692, 7.573409],
    "HSLM-A7": [9.469584, 10.20521, 55.68435, 16.85602],
    "HSLM-A9": [19.56476, 10.99256, 26.55292, 64.65258],
}


@pytest.mark.parametrize("train", PEAKS)
def test_peaks_agree_with_an_independent_implementation(train):
    numbers = {"beam.modes": 9, "run.duration": 10.0, "run.sample_rate": 20.0}
    case = with_settings(CASE, numbers | {"loads.0.train": train})
    speeds = SPEEDS / 3.6
    runs = [jb.simulate(jb.replace(case, {"loads.0.speed": v}), tolerance=1e-5) for v in speeds]
    found = [1e3 * float(run.peak_deflection[0]) for run in runs]
    assert_allclose(found, PEAKS[train], rtol=1.4e-4)
