"""Forces in closed form: against the integrator, and the equation of a particular solution."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import linear_outputs, sensor_rows
from jaxbeam.numerics.polynomials import piecewise_chebyshev
from jaxbeam.simulation.integrator.force_peaks import (
    ForcePaths,
    force_paths,
    force_wheels,
    peaks_of_forces,
)
from jaxbeam.simulation.integrator.force_system import (
    force_responses,
    force_system,
    particular_solutions,
)
from jaxbeam.simulation.integrator.step_size import without_later_vibration
from jaxbeam.simulation.section_forces import outputs_of_forces
from jaxbeam.simulation.sweeps.computation import SAMPLES, WorstRun, estimated_errors
from jaxbeam.simulation.sweeps.force_runner import _systems, force_runner
from jaxbeam.simulation.sweeps.specification import sweep_specification

BEAM = jb.Beam(12.0, 4e8, 2000.0, 0.02, modes=3)
QUANTITIES = ("deflection", "velocity", "acceleration", "slope", "moment", "shear")
ROW = jb.Axles(speed=25.0, offsets=[0.0, 2.5, 7.0, 9.5, 21.0], forces=[1e5, 1e5, 9e4, 9e4, 1.2e5])
BACK = jb.Axles(speed=-18.0, offsets=[0.0, 3.0, 6.0], forces=[7e4] * 3, entry_time=0.2)
TWO_SPANS = jb.Case(
    BEAM,
    supports=[jb.Support(5.0, stiffness=2e7, damping=3e4)],
    sensors=[jb.Sensor(8.0, quantity) for quantity in QUANTITIES],
    loads=[ROW, BACK],
    run=jb.Run(2.0),
)
TIMOSHENKO = dataclasses.replace(
    TWO_SPANS,
    beam=dataclasses.replace(BEAM, shear_stiffness=1e8),
    supports=(),
    # At t = 0 some are on the beam, and one enters it.
    loads=[
        dataclasses.replace(ROW, entry_time=-0.47),
        dataclasses.replace(BACK, entry_time=0.0),
    ],
)


def runner_of(case, over):
    plan = sweep_specification(case, over, False, False, 1e-8, "double")
    return force_runner(case, plan.batches, 1e-8, plan.block_bytes)


@pytest.mark.parametrize("case", [TWO_SPANS, TIMOSHENKO], ids=["two spans", "Timoshenko"])
def test_peaks_equal_those_of_the_integrator(case):
    runner = runner_of(case, {"loads.0.speed": [25.0]})
    phases, error = runner.choose_step_sizes()
    found = {name: values[0, 0] for name, values in runner.block_function(phases)(0).items()}
    record = jb.simulate(case, tolerance=1e-9)
    largest = np.maximum(np.abs(record.smallest), record.largest)
    for i, quantity in enumerate(QUANTITIES):
        assert_allclose(found["peak_deflection"][i], largest[i], rtol=1e-8, err_msg=quantity)
    assert error < 1e-8
    assert_allclose(found["lowest_contact_force"], record.lowest_contact_force)
    assert np.isnan(found["contact_lost_time"]).all()


def test_stored_sweeps_whose_last_block_is_short_have_every_run_in_its_place(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxbeam.simulation.sweeps.force_runner.FORCE_BLOCK_RUNS", 4)
    speeds = {"loads.0.speed": [20.0, 22.0, 24.0, 26.0, 28.0, 30.0]}
    case = dataclasses.replace(TWO_SPANS, sensors=[jb.Sensor(8.0)])
    in_memory = jb.sweep(case, speeds, progress=False)
    stored = jb.sweep(case, speeds, store=tmp_path / "runs.zarr", progress=False)
    assert_allclose(stored.peak_deflection, in_memory.peak_deflection, rtol=1e-12)


def system_of(case):
    """System of a case whose outputs have no static part."""
    model = modal_model(case)
    outputs = linear_outputs(model, sensor_rows(model, case, case.sensors), None)
    return force_system(model, outputs, np.zeros(0))


def test_particular_solutions_satisfy_their_equation():
    system, speeds = system_of(TWO_SPANS), np.array([-300.0, 5.0, 60.0])
    x = np.linspace(0.1, 11.9, 40)
    forces = np.concatenate([system.forces.real, system.forces.imag], axis=-1)
    b = piecewise_chebyshev(system.nodes, forces, x, (0,))[0]
    b = b[:, : system.poles.size] + 1j * b[:, system.poles.size :]
    for speed, solution in zip(speeds, particular_solutions(system, speeds), strict=True):
        parts = np.concatenate([solution.real, solution.imag], axis=-1)
        p, slope = (
            whole[:, : system.poles.size] + 1j * whole[:, system.poles.size :]
            for whole in piecewise_chebyshev(system.nodes, parts, x, (0, 1))
        )
        residual = speed * slope - system.poles * p - b
        assert np.abs(residual).max() < 1e-9 * np.abs(b).max()


def test_the_bound_on_the_second_derivative_of_a_response():
    """Of a slow force the largest is that of the first and third mode as it passes midspan."""
    case = jb.Case(BEAM, sensors=[jb.Sensor(6.0)], loads=[ROW])
    speeds = np.array([0.05, 0.2])
    found = force_responses(system_of(case), speeds).curvature.max(axis=(1, 2))
    expected = speeds**2 * 2 * 12.0 / (np.pi**2 * 4e8) * (1 + 1 / 9)
    assert np.all(expected <= found) and np.all(found <= 1.6 * expected), found / expected


def test_no_peak_is_missed_among_random_forces():
    """Against dense samples of the same motion: they are below the peaks, and close to them."""
    rng, runs, wheels = np.random.default_rng(5), 12, 9
    names, places = ("deflection", "velocity", "slope"), (1.0, 2.5, 6.0, 8.0)  # more than modes
    sensors = [jb.Sensor(x, name) for name in names for x in places]
    system = system_of(dataclasses.replace(TWO_SPANS, sensors=sensors))
    speed = rng.choice([-40.0, -9.0, 7.0, 25.0, 110.0], (runs, wheels))
    origin = rng.uniform(-6, 18, (runs, wheels)) - speed * rng.uniform(0, 1, (runs, 1))
    paths = ForcePaths(origin, speed, rng.normal(0, 1e5, wheels), rng.uniform(0.8, 1.4, runs))
    found = peaks_of_forces(force_responses(system, np.unique(speed)), paths, 1.6)
    for run in range(runs):
        own = ForcePaths(origin[run : run + 1], speed[run : run + 1], paths.force, paths.duration)
        own = own._replace(duration=paths.duration[run : run + 1])
        times = np.linspace(0, own.duration[0], 8001)
        sampled = np.abs(outputs_of_forces(system, own, times))
        peak = found.peak_deflection[run, 0]
        assert np.all(peak >= sampled.max(axis=0) * (1 - 1e-12))
        assert_allclose(peak, sampled.max(axis=0), rtol=1e-4)
        at_peak = np.abs(outputs_of_forces(system, own, found.peak_time[run, 0]))
        assert_allclose(np.diag(at_peak), peak, rtol=1e-9)


def test_paths_are_those_of_the_loads():
    """Runs that differ in speed, entry, start, spacing and duration, against each as a case."""
    wagon = jb.Axles(
        speed=20.0, offsets=[0.0, 2.0], forces=[1e5] * 2, count=3, spacing=7.0, start_position=0.0
    )
    case = dataclasses.replace(TWO_SPANS, loads=[wagon, BACK])
    names = "loads.*.speed", "loads.0.spacing", "loads.1.entry_time", "loads.0.start_position"
    names += ("run.duration",)
    values = np.array([[12.0, 5.0, 0.1, -3.0, 2.0], [-30.0, 8.0, 0.0, 4.0, 1.5]])
    paths = force_paths(case, force_wheels(case), names, values)
    for run, row in enumerate(values):
        one = jb.replace(case, dict(zip(names, row, strict=True)))
        loads, times = load_set(one), np.array([0.2, 0.9])
        x = paths.origin[run, :, None] + paths.speed[run, :, None] * times
        assert_allclose(x, loads.kinematics(times)[0], atol=1e-12)
        windows = np.clip(loads.entry_exit_times(), 0, row[-1])
        assert_allclose(np.transpose(paths.windows(0.0, 12.0))[:, run], windows, atol=1e-12)
        assert_allclose(paths.force, -loads.weight[:, 0])


def test_truncation_errors_are_those_of_the_integrated_run():
    # Of the passage, and of one period of the first mode after it.
    case = without_later_vibration(TWO_SPANS, modal_model(TWO_SPANS), load_set(TWO_SPANS))
    assert case.run.duration < TWO_SPANS.run.duration
    times = np.linspace(0, case.run.duration, SAMPLES)
    record = jb.simulate(case, times, tolerance=1e-9)
    largest = np.abs(record.sensor_values).max(axis=0)
    run = WorstRun({"loads.0.speed": 25.0}, largest)
    closed_form = estimated_errors(TWO_SPANS, dict.fromkeys(QUANTITIES, run))
    for quantity in ("velocity", "acceleration", "moment", "shear"):
        error = record.truncation_errors[QUANTITIES.index(quantity)]
        assert_allclose(closed_form[quantity], error, rtol=1e-6)


def test_other_sweeps_are_integrated():
    speeds = {"loads.0.speed": [20.0, 25.0]}
    assert runner_of(TWO_SPANS, speeds) is not None
    assert runner_of(TWO_SPANS, {"beam.length": [12.0, 13.0]}) is None
    braking = dataclasses.replace(TWO_SPANS, loads=[ROW, dataclasses.replace(BACK, deceleration=1)])
    heavy = dataclasses.replace(ROW, masses=[10.0] * 5)
    free = dataclasses.replace(BEAM, ends="free-free")
    for case in (
        braking,
        dataclasses.replace(TWO_SPANS, loads=[heavy, BACK]),
        dataclasses.replace(TWO_SPANS, loads=[ROW]),  # fewer wheels
        dataclasses.replace(TWO_SPANS, beam=free, supports=(), sensors=TWO_SPANS.sensors[:3]),
    ):
        assert runner_of(case, speeds) is None


def test_static_parts_of_tapered_beams_are_exact_between_the_breaks():
    """Against the exact flexibility; pieces of panels hold several of the interpolation."""
    segments = [jb.Segment(4.0, [8e8, -4e8], 2000.0), jb.Segment(8.0, [4e8, 4e8], 2000.0)]
    beam = jb.Beam(12.0, damping_ratio=0.02, modes=3, segments=segments)
    sensors = [jb.Sensor(3.0, "moment"), jb.Sensor(7.0, "shear")]
    case = dataclasses.replace(TWO_SPANS, beam=beam, supports=(), sensors=sensors)
    runner = runner_of(case, {"loads.0.speed": [25.0]})
    system = (_systems(runner.system) or [])[0]
    x = np.linspace(0.0, 12.0, 1000)[1:-1]
    piece = np.searchsorted(system.breaks, x) - 1
    rows = np.asarray(system.static.rows)
    model = modal_model(case)
    quasi_static = np.linalg.solve(model.stiffness(), np.asarray(model.shapes(x, (0,))[0]).T)
    found = system.static_part(x, piece) + (rows[:, ::2] @ quasi_static).T
    for i, sensor in enumerate(sensors):
        exact = -np.asarray(jb.influence_line(case, sensor.position, x, quantity=sensor.quantity))
        assert_allclose(
            found[:, i], exact, atol=1e-7 * np.abs(exact).max(), err_msg=sensor.quantity
        )
        one = system.static_part(x, piece, np.full(x.size, i))
        assert_allclose(one, system.static_part(x, piece)[:, i], rtol=1e-12)
