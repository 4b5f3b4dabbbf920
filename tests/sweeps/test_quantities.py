"""Peaks of every quantity in sweeps: against dense samples of single runs."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.integrator.monitored_rows import largest_per_energy
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.sensing.output_rows import modal_row, sensor_rows
from jaxbeam.sweeps.truncation import TruncationWarning

BEAM = jb.Beam(1.2, 11.68, 0.535, 0.02, modes=3)
FOLLOWED = ("deflection", "velocity", "acceleration", "slope", "curvature", "strain", "moment")
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
    "command": jb.Case(
        BEAM,
        actuators=[jb.Patch(0.4, 0.5, 2e-3, limits=[-200, 200])],
        controller=jb.Feedback(gains=[2e4], period=0.002),
        sensors=[jb.Sensor(0.45), jb.Sensor(0.3, "acceleration"), jb.Sensor(0.3, "velocity")],
        loads=[jb.MovingForce(force=3.0, speed=4.0)],
        run=jb.Run(0.4, sample_rate=20000.0),
    ),
}


def of_modes(record: jb.Record, sensor: jb.Sensor) -> np.ndarray:
    """History of a sensor's quantity as the sum of the modes."""
    modes, motion = record.modes, record.motion
    parameters = sensor.position, sensor.quantity, sensor.fibre_distance
    row = modal_row(modes.fields, record.case, *parameters)
    return np.asarray(motion[QUANTITIES[sensor.quantity].time_derivative]) @ np.asarray(row)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxbeam.sweeps.truncation.TruncationWarning")
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
        history = of_modes(record, sensor)
        expected = np.abs(history).max()
        assert_allclose(peaks[1, i], expected, rtol=1e-4, err_msg=sensor.quantity)
        assert float(peaks[1, i]) >= expected * (1 - 1e-7)
        when = np.abs(history).argmax()
        assert_allclose(found["peak_time"][1, i], record.times[when], atol=1e-4)
        others = [j for j, other in enumerate(case.sensors) if other.quantity != sensor.quantity]
        assert np.isnan(peaks[:, others]).all()


def test_sums_of_modes_are_warned_of_with_the_missing_share():
    """Midspan with three modes: 1 - (8 / pi^2)(1 + 1 / 9) of P L / 4 is missing, 9.9 %."""
    gauge = jb.Sensor(0.6, "strain", fibre_distance=1e-3)
    case = dataclasses.replace(CASES["force"], sensors=(gauge,))
    assert round(100 * (1 - 8 / np.pi**2 * (1 + 1 / 9)), 1) == 9.9
    with pytest.warns(TruncationWarning, match=r"sensors.0 \(strain\) are sums of 3 modes.* 9.9%"):
        found = jb.sweep(case, {"loads.0.force": [3.0]}, progress=False)
    assert found["peak_strain"].attrs["long_name"] == "largest absolute strain, sum of 3 modes"


def test_shear_forces_are_refused():
    case = dataclasses.replace(CASES["force"], sensors=(jb.Sensor(0.6, "shear"),))
    with pytest.raises(ValueError, match=r"sensors.0 measures shear, whose sum of modes converges"):
        jb.sweep(case, {"loads.0.force": [3.0]}, progress=False)


def test_free_outputs_are_bounded_by_the_energy():
    case = CASES["masses"]
    model = modal_model(case)
    rows = sensor_rows(model, case, SENSORS)
    bound = largest_per_energy(model, rows)
    C, _ = rows.of_system(model, model.A, np.zeros((model.state_count, 0)))
    states = np.random.default_rng(1).normal(size=(model.state_count, 4000))
    states[model.coordinate_index] /= model.modes.angular_frequencies[:, None]
    q, rates = states[model.coordinate_index], states[model.rate_index]
    energy = np.sum(rates**2, axis=0) + np.sum(q * (model.stiffness() @ q), axis=0)
    share = (C @ states) ** 2 / (bound[:, None] * energy)
    assert np.all(share <= 1) and np.all(share.max(axis=1) > 0.2)
