"""Vehicles in the C integrator: peaks of random vehicles as those of the steps in NumPy."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import sensor_rows
from jaxbeam.runtime import native_library
from jaxbeam.simulation.integration_plan import static_shapes
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.discrete_model import discrete_model
from jaxbeam.simulation.integrator.integrate import integrate_peaks
from jaxbeam.simulation.integrator.time_grid import grid_by_step_length
from tests.oracles.crossing import Load
from tests.oracles.modal_equations import Span, respond

pytestmark = pytest.mark.skipif(native_library.find_compiler() is None, reason="no C compiler here")

BEAM = jb.Beam(20.0, 1e10, 1e4, damping_ratio=0.01, modes=2)
CAR = jb.QuarterCar(
    speed=25.0,
    body_mass=16000.0,
    axle_mass=1200.0,
    suspension_stiffness=8e5,
    suspension_damping=2e4,
    tyre_stiffness=3.5e6,
    tyre_damping=1e4,
)
# Longer than the beam: for a while it vibrates without a wheel on it.
LONG_CAR = jb.vehicles.HalfCar(
    speed=-50.0,
    entry_time=0.1,
    body_mass=10000.0,
    body_inertia=2e5,
    axle_positions=[12.0, -11.0],
    axle_masses=[1000.0, 900.0],
    suspension_stiffness=[1e6, 8e5],
    suspension_damping=[1e4, 2e4],
    tyre_stiffness=[1e6, 2e6],
    tyre_damping=[1e4, 5e3],
)
SENSORS = [jb.Sensor(7.0), jb.Sensor(10.0, "acceleration")]
# Body on a wheel with mass: inertia and springs in the same rows; vehicles in a row.
ROW = jb.vehicles.VehicleLoad(
    bodies=[jb.vehicles.VehicleBody("body", mass=3e4, inertia=4e5, position=0.0)],
    axles=[
        jb.vehicles.VehicleAxle(
            "body", p, mass=500.0, suspension_stiffness=k, suspension_damping=2e4
        )
        for p, k in ((2.0, 2e6), (-2.5, 3e6))
    ],
    count=2,
    spacing=8.0,
    speed=20.0,
    deceleration=3.0,
)
PULSE = jb.VaryingForce(
    force_times=[0.0, 0.5, 0.9],
    forces=[1e4, 3e4, 2e4],
    speed=12.0,
    frequencies=[2.0],
    amplitudes=[8e3],
)
CASES = {
    "meeting": ((CAR, LONG_CAR, jb.MovingMass(mass=4000.0, speed=-15.0)), ()),
    "rough": ((CAR, LONG_CAR, jb.MovingMass(mass=4000.0, speed=-15.0)), ()),
    "forced": ((CAR, PULSE, jb.MovingMass(mass=4000.0, speed=-15.0)), ()),
    "row": ((jb.MovingForce(force=2e4, speed=30.0), ROW), (jb.Support(6.0, 1e7, damping=1e5),)),
}
FACTORS = st.lists(st.floats(0.2, 3.0), min_size=24, max_size=24)


def case_of(name):
    loads, supports = CASES[name]
    profile = jb.profiles.ISO8608Profile("C", seed=2) if name in ("rough", "forced") else None
    return jb.Case(
        BEAM, supports=supports, sensors=SENSORS, loads=loads, profile=profile, run=jb.Run(2.2)
    )


def numbers_of_vehicles(case):
    """Addresses of masses, inertias, springs and dampers of the loads."""
    names = ("mass", "inertia", "stiffness", "damping")
    found = [a for a, value in jb.addresses(case).items() if np.ndim(value) == 0]
    found = [a for a in found if a.startswith("loads.")]
    return [a for a in found if any(name in a.split(".", 2)[2] for name in names)]


def inputs_of_runs(case, batch):
    """Shapes, model, grid, outputs, and loads of runs with some numbers of the loads."""
    shapes = static_shapes(case)
    model = modal_model(case, shapes.layout, shapes.coupled)
    grid = grid_by_step_length(case, model, np.asarray(8e-3))
    wheels = [load_set(replace(case, numbers)).wheels for numbers in batch]
    wheels = jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1), *wheels)
    loads = dataclasses.replace(load_set(case), wheels=wheels)
    return shapes.max_loads, (model, grid, sensor_rows(model, case, case.sensors), loads)


@pytest.fixture(autouse=True)
def library(native_cache, monkeypatch):
    """The C integrator, compiled into a cache folder of the tests."""
    monkeypatch.setenv("XDG_CACHE_HOME", native_cache)


@pytest.mark.parametrize("name", CASES)
def test_peaks_are_those_of_the_steps_in_numpy(name):
    case = case_of(name)
    addresses = numbers_of_vehicles(case)
    values = np.array([jb.addresses(case)[address] for address in addresses])

    def inputs_of_one(model, grid, outputs, loads):
        of_model = native_peaks.model_inputs(model, outputs, None)
        of_batch = native_peaks.batch_inputs(grid, loads.cubics(), loads.wheels)
        one = jax.tree.map(lambda part: np.asarray(part)[None], of_model | of_batch)
        of_panels = (one[name] for name in ("panel_starts", "step_counts", "step_lengths"))
        one |= native_peaks.inputs_over_time([loads], *of_panels, one_profile=True)
        return native_peaks.NativeInputs(**one)

    @settings(max_examples=4, phases=[Phase.generate])
    @given(FACTORS)
    def equal(factors):
        first, second = np.array(factors[: values.size]), np.array(factors[::-1][: values.size])
        batch = [dict(zip(addresses, values * part, strict=True)) for part in (first, second)]
        max_loads, (model, grid, outputs, loads) = inputs_of_runs(case, batch)
        discrete = discrete_model(model, grid, None, None, outputs)
        expected = integrate_peaks(discrete, loads, max_loads=max_loads)[0].peaks()
        inputs = inputs_of_one(model, grid, outputs, loads)
        peaks = native_peaks.integrate_peaks(max_loads, np.ones(1, bool), inputs)
        found = jax.tree.map(lambda part: part[0], peaks)
        for part, known in zip(found[::2], expected[::2], strict=True):
            assert_allclose(part, known, rtol=1e-10, atol=1e-10)
        assert_allclose(found.contact_lost_time, expected.contact_lost_time, rtol=1e-10)

    equal()


def test_sweeps_of_vehicles_take_their_steps_in_c():
    case = case_of("meeting")
    assert native_peaks.supports(case)
    assert native_peaks.supports(case_of("rough")) and native_peaks.supports(case_of("forced"))
    settled = dataclasses.replace(case, supports=(jb.Support(6.0, settlement=1e-3),))
    assert not native_peaks.supports(settled)


def test_sweeps_of_axles_that_go_left_and_speed_up_are_those_of_scipy():
    """Forces and masses 4 m apart, in the peaks of sweeps, which follow the cubics of the paths."""
    times = np.linspace(0.0, 1.5, 3001)
    assert native_peaks.available()
    beam = jb.Beam(20.0, 2e10, 1.2e4, 0.02, modes=3)
    span = Span(20.0, 2e10, 1.2e4, modes=3, damping_ratio=0.02)
    sensors = [jb.Sensor(7.0), jb.Sensor(12.0)]
    over = {"loads.0.deceleration": [-6.0, 3.0]}
    for kind, numbers in (("force", {"forces": 9e4}), ("mass", {"masses": 9e4 / 9.81})):
        row = jb.Axles(offsets=[0.0, 4.0], speed=-18.0, start_position=20.0, **numbers)
        case = jb.Case(beam, sensors=sensors, loads=[row], run=jb.Run(1.5))
        found = jb.sweep(case, over, progress=False).peak_deflection
        for deceleration, peaks in zip(over["loads.0.deceleration"], found, strict=True):
            # The second enters later, and faster or slower.
            speed = np.sqrt(18.0**2 - 8.0 * deceleration)
            entry = (18.0 - speed) / deceleration
            axles = (18.0, 0.0), (speed, entry)
            loads = [Load(9e4 / 9.81, -v, t, deceleration, kind) for v, t in axles]
            expected = respond(span, loads, [7.0, 12.0], times).deflection
            assert_allclose(peaks, np.max(np.abs(expected), axis=0), rtol=1e-4)
