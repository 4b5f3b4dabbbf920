"""Sweeps: agreement with single runs, failed runs, stores, and resuming after a kill."""

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
import xarray
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case import fields
from jaxbeam.case.case import replace
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.integrator.force_peaks import peaks_of_forces
from jaxbeam.simulation.integrator.peaks import Peaks
from jaxbeam.simulation.integrator.time_grid import event_places, grid_by_step_length
from jaxbeam.simulation.sweeps import force_runner
from jaxbeam.simulation.sweeps.batches import make_batches
from jaxbeam.simulation.sweeps.blocks import Runner
from jaxbeam.simulation.sweeps.computation import FailedRunsWarning
from jaxbeam.simulation.sweeps.step_size import path_times
from jaxbeam.simulation.sweeps.store import block_places

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=[0.03, 0.02], modes=2),
    supports=[jb.Support(0.4, stiffness=2e4)],
    sensors=[jb.Sensor(0.15), jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.4, speed=2.0)],
    run=jb.Run(duration=0.5),
)
MASSES, SPEEDS = [0.1, 0.4, 0.9], [1.5, 4.0]


def single_run_peaks(values) -> np.ndarray:
    """Peaks of one simulation."""
    return np.asarray(jb.simulate(jb.replace(CASE, values)).peak_deflection)


OF_PLAUSIBILITY = "jaxbeam.model.plausibility.check.PlausibilityWarning"
IMPLAUSIBLE = pytest.mark.filterwarnings(f"ignore::{OF_PLAUSIBILITY}")


def sweep(over, **options) -> xarray.Dataset:
    return jb.sweep(CASE, over, progress=False, **options)


@pytest.fixture(scope="module")
def grid_dataset():
    return sweep({"loads.0.mass": MASSES, "loads.0.speed": SPEEDS})


def test_grid_is_labelled_by_address_and_agrees_with_single_runs(grid_dataset):
    assert grid_dataset.peak_deflection.dims == ("loads.0.mass", "loads.0.speed", "sensor")
    assert grid_dataset.peak_deflection.units == "m"
    assert not grid_dataset.failed.any()
    assert grid_dataset.error_estimate <= 1e-7
    for mass in MASSES[::2]:
        for speed in SPEEDS:
            found = grid_dataset.peak_deflection.sel({"loads.0.mass": mass, "loads.0.speed": speed})
            expected = single_run_peaks({"loads.0.mass": mass, "loads.0.speed": speed})
            assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("shared_model", [True, False])
def test_loads_cross_in_length_over_speed(shared_model):
    speeds = np.linspace(1.0, 4.0, 30)
    case = dataclasses.replace(CASE, supports=[jb.Support(0.4)])
    model = modal_model(case, mesh_layout(case), False)
    places = event_places(model, None) if shared_model else np.zeros(0)
    found = path_times(case, ("loads.0.speed",), speeds[:, None], places)
    windows, events = found.load_events
    assert_allclose(windows[:, 0, 1], 0.6 / speeds, rtol=1e-13)
    assert np.all(windows[:, 0, 0] == 0) and np.all(np.isinf(found.force_steps))
    passages = np.any(np.isclose(events, (0.4 / speeds)[:, None], rtol=1e-12), axis=1)
    assert passages.all() if shared_model else not passages.any()


def test_paths_of_tables_are_those_of_each():
    """Values of a table of positions are not vectorised, but compiled."""
    load = jb.MovingMass(mass=0.5, times=[0.0, 0.2, 0.5], positions=[0.0, 0.2, 0.6])
    case, times = dataclasses.replace(CASE, loads=[load]), np.linspace(0.1, 0.3, 4)
    places = np.array([0.3])
    found = path_times(case, ("loads.0.times.1",), times[:, None], places)
    for i, middle in enumerate(times):
        loads = load_set(replace(case, {"loads.0.times.1": middle}))
        for part, one in zip(found.load_events, loads.events(places), strict=True):
            assert_allclose(part[i], one, rtol=1e-12, atol=1e-12)


def test_the_time_grid_is_the_same_with_known_load_events():
    case = dataclasses.replace(CASE, supports=[jb.Support(0.4)])
    model, speeds = modal_model(case, mesh_layout(case), False), np.linspace(1.0, 4.0, 3)
    places = event_places(model, None)
    events = path_times(case, ("loads.0.speed",), speeds[:, None], places).load_events
    for i, speed in enumerate(speeds):
        varied = replace(case, {"loads.0.speed": speed})
        found, expected = (
            grid_by_step_length(varied, model, np.asarray(1e-2), given_events=known)
            for known in (jax.tree.map(lambda part, i=i: part[i], events), None)
        )
        assert eqx.tree_equal(found, expected)


@pytest.mark.parametrize(
    ("modes", "supports", "speeds"),
    [(1, [], np.geomspace(0.3, 30, 48)), (3, [jb.Support(0.35)], np.linspace(0.3, 10, 48))],
)
def test_errors_stay_below_the_tolerance_at_critical_speeds(modes, supports, speeds):
    """Errors of a heavy mass are there ten times those at slightly other speeds."""
    beam = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=modes)
    case = dataclasses.replace(CASE, beam=beam, supports=supports, run=jb.Run(2.3))
    over = {"loads.0.mass": np.linspace(0.1, 1.0, 16), "loads.0.speed": speeds}
    finer = jb.sweep(case, over, progress=False, tolerance=1e-10)
    for tolerance in (1e-7, 9e-7):
        found = jb.sweep(case, over, progress=False, tolerance=tolerance)
        error = np.abs(found.peak_deflection / finer.peak_deflection - 1)
        assert error.max() < tolerance


def test_paired_values():
    over = {
        "beam.flexural_rigidity": [10.0, 12.0],
        "supports.0.position": [0.35, 0.45],
        "supports.0.stiffness": [1e4, 1e6],
        "beam.damping_ratio.1": [0.01, 0.05],
        "sensors.1.position": [0.2, 0.5],
        "loads.0.mass": [0.2, 0.3],
        "run.gravity": [9.81, 5.0],
    }
    found = sweep(over, paired=True)
    assert found.peak_deflection.dims == ("run", "sensor")
    assert_allclose(found["run.gravity"], over["run.gravity"])
    for i in range(2):
        expected = single_run_peaks({address: values[i] for address, values in over.items()})
        assert_allclose(found.peak_deflection[i], expected, rtol=1e-6)


def test_histories_on_request():
    found = sweep({"loads.0.mass": MASSES, "loads.0.speed": [2.0]}, histories=True)
    assert found.deflection.dims == ("loads.0.mass", "loads.0.speed", "time", "sensor")
    record = jb.simulate(jb.replace(CASE, {"loads.0.mass": MASSES[1]}))
    assert_allclose(found.time, record.times)
    assert_allclose(found.deflection[1, 0], record.deflection, atol=1e-10)


@IMPLAUSIBLE
def test_failed_run_is_marked_and_changes_no_other(monkeypatch):
    """An infinite weight, which is refused otherwise, makes one run fail."""
    monkeypatch.setattr(fields, "LARGEST", np.inf)
    masses, gravity = [*MASSES, 100.0], [9.81, 9.81, 9.81, 1e308]
    with pytest.warns(FailedRunsWarning, match="1 of 4 runs failed, the first at loads"):
        dataset = sweep({"loads.0.mass": masses, "run.gravity": gravity}, paired=True)
    assert dataset.failed_runs == 1 and 0 < dataset.error_estimate < 1e-7
    assert dataset.failed.values.tolist() == [False, False, False, True]
    assert np.isnan(dataset.peak_deflection[-1]).all()
    without_failure = sweep({"loads.0.mass": MASSES, "run.gravity": gravity[:3]}, paired=True)
    assert_allclose(dataset.peak_deflection[:-1], without_failure.peak_deflection, rtol=1e-12)


@IMPLAUSIBLE
@pytest.mark.parametrize("by_forces", [False, True], ids=["integrated", "in closed form"])
def test_runs_that_all_fail_are_told(by_forces, monkeypatch, tmp_path):
    """In memory and in a store, also when its complete results are read again; their error is NaN.

    Infinite weights, which are refused otherwise; motions that are not finite.
    """
    monkeypatch.setattr(fields, "LARGEST", np.inf)

    def no_peaks(*given):
        return Peaks(*(np.full_like(part, np.nan) for part in peaks_of_forces(*given)))

    monkeypatch.setattr(force_runner, "peaks_of_forces", no_peaks)
    case, over = CASE, {"run.gravity": [1e308], "loads.0.mass": [100.0, 200.0]}
    if by_forces:
        train = jb.Axles(speed=2.0, offsets=0.01 * np.arange(9), forces=[0.1] * 9)
        case, over = dataclasses.replace(CASE, loads=[train]), {"loads.0.speed": [1.0, 2.0]}
    store = {"store": tmp_path / "runs.zarr", "resume": True}
    for options in ({}, store, store):
        with pytest.warns(FailedRunsWarning, match="all 2 runs failed, the first at"):
            found = jb.sweep(case, over, progress=False, **options)
        assert found.failed.all() and found.failed_runs == 2 and np.isnan(found.error_estimate)
        assert np.isnan(found.peak_deflection).all()


def test_store_holds_the_returned_dataset(grid_dataset, tmp_path):
    over = {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS}
    path = tmp_path / "runs.zarr"
    xarray.testing.assert_identical(sweep(over, store=path), grid_dataset)
    stored = xarray.open_zarr(path, consolidated=False)
    assert_array_equal(stored.peak_deflection, grid_dataset.peak_deflection)
    resumed = sweep(over, store=path, resume=True)
    assert_array_equal(resumed.peak_deflection, grid_dataset.peak_deflection)
    assert_array_equal(resumed.sensor, grid_dataset.sensor)
    with pytest.raises(FileExistsError, match="holds a sweep already"):
        sweep(over, store=path)
    with pytest.raises(ValueError, match="cannot be resumed"):
        sweep({"loads.0.mass": [0.3]}, store=path, resume=True)
    (tmp_path / "other").mkdir()
    with pytest.raises(FileExistsError, match="not a sweep"):
        sweep(over, store=tmp_path / "other", overwrite=True)
    assert (tmp_path / "other").exists()


MANY = {"loads.0.mass": np.linspace(0.1, 0.9, 256), "loads.0.speed": np.linspace(1, 4, 24)}


def blocks_written(store: Path) -> set[int]:
    """Numbers of the blocks that are written to an unfinished store."""
    files = store.glob("blocks/*/*.blocks")
    with contextlib.suppress(FileNotFoundError):  # the sweep has ended in between
        return {place.block for file in files for place in block_places(file)}
    return set()


KILLED = """
import sys
import tests.simulation.sweeps.test_sweep as t
t.sweep(t.MANY, store=sys.argv[1])
"""


def test_killed_sweep_resumes_bit_identically(tmp_path):
    """The killed process, and this one, which resumes and computes the whole."""
    complete, interrupted = tmp_path / "whole.zarr", tmp_path / "cut.zarr"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(interrupted)])
    while process.poll() is None and len(blocks_written(interrupted)) < 3:
        time.sleep(0.001)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert (interrupted / "blocks").exists(), "killed after the sweep was complete"
    sweep(MANY, store=interrupted, resume=True)
    sweep(MANY, store=complete)
    first, second = (
        xarray.open_zarr(path, consolidated=False).load() for path in (complete, interrupted)
    )
    xarray.testing.assert_identical(first.drop_attrs(), second.drop_attrs())


@pytest.mark.parametrize(
    ("over", "message"),
    [
        ({}, "at least one address"),
        ({"loads.0.speeed": [1.0]}, "did you mean 'loads.0.speed'"),
        ({"loads.0.mass": []}, "list of values"),
        ({"loads.0.mass": [0.1, np.nan]}, r"loads\.0\.mass"),
        ({"loads.0.mass": [0.1, -1.0]}, r"loads\.0\.mass"),
        ({"sensors.0.position": [0.1, 0.7]}, r"sensors\.0\.position"),
        ({"beam.damping_ratio": [0.1]}, "is a list"),
    ],
)
def test_invalid_values_are_refused(over, message):
    with pytest.raises(ValueError, match=message):
        sweep(over)


def test_other_errors_are_named():
    with pytest.raises(ValueError, match="equally many"):
        sweep({"loads.0.mass": [0.1], "loads.0.speed": [1.0, 2.0]}, paired=True)
    with pytest.raises(ValueError, match="no sensors"):
        jb.sweep(jb.Case(CASE.beam, loads=CASE.loads, run=CASE.run), {"loads.0.mass": [1.0]})
    two = jb.Case(CASE.beam, [*CASE.supports, jb.Support(0.2)], sensors=CASE.sensors)
    with pytest.raises(ValueError, match="change their order"):
        jb.sweep(two, {"supports.1.position": [0.2, 0.5]}, progress=False)
    controlled = dataclasses.replace(
        CASE,
        actuators=(jb.PointForce(0.2),),
        controller=jb.Feedback(gains=[1.0], period=0.01),
    )
    with pytest.raises(ValueError, match="controller.period determines the schedule"):
        jb.sweep(controlled, {"controller.period": [0.01, 0.02]}, progress=False)


def test_each_run_has_the_controller_designed_for_its_loads():
    beam = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=1)
    law = jb.LQR(state_weight=[1e3, 1.0], command_weight=[1e-2], points=40, horizon="frozen")
    case = jb.Case(
        beam, actuators=[jb.PointForce(0.3)], sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.2, speed=2.0)], controller=law,
        run=jb.Run(duration=0.4, sample_rate=200.0),
    )  # fmt: skip
    found = jb.sweep(case, {"loads.0.mass": [0.2, 0.8]}, progress=False)
    single_run = jb.simulate(jb.replace(case, {"loads.0.mass": 0.8}))
    np.testing.assert_allclose(found.peak_deflection[1], single_run.peak_deflection, rtol=1e-6)


@given(st.integers(1, 400), st.integers(1, 5), st.integers(0, 10))
def test_every_run_is_in_one_batch(count, paths, seed):
    random = np.random.default_rng(seed)
    speeds = random.integers(0, paths, count).astype(float)
    masses = random.random(count)
    values = np.stack([speeds, masses], axis=1)
    batches = make_batches(["loads.0.speed", "loads.0.mass"], values, ["loads.0.mass"])
    mask = batches.run_index >= 0
    assert sorted(batches.run_index[mask]) == list(range(count))
    rows = np.broadcast_to(batches.shared_values[:, None, 0], batches.run_index.shape)
    assert_array_equal(rows[mask], speeds[batches.run_index[mask]])
    assert_array_equal(batches.batched_values[..., 0][mask], masses[batches.run_index[mask]])


@pytest.mark.parametrize("count", [255, 256, 257, 384, 385, 512, 513, 1000])
def test_hardly_a_run_of_a_batch_is_padding(count):
    values = np.stack([np.repeat([1.0, 2.0], count), np.arange(2.0 * count)], axis=1)
    batches = make_batches(["loads.0.speed", "loads.0.mass"], values, ["loads.0.mass"])
    assert batches.run_index.size <= 1.01 * 2 * count and batches.run_index.shape[1] <= 384
    few = make_batches(["loads.0.speed", "loads.0.mass"], values, ["loads.0.mass"], most=10)
    assert few.run_index.shape[1] <= 10


def test_progress_bar_is_on_standard_error(capfd):
    jb.sweep(CASE, {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS})
    captured = capfd.readouterr()
    assert captured.out == "" and "run" in captured.err


@pytest.mark.parametrize(("modes", "damping"), [(3, 0.03), (6, 0.0), (12, 0.005)])
def test_longest_steps_are_stable(modes, damping):
    """They resolve the highest mode, which longer steps excite under a heavy load."""
    masses, speeds = np.array([0.1, 1.0, 8.0]), np.linspace(0.1, 0.35, 7)
    beam = jb.Beam(
        length=0.6,
        flexural_rigidity=11.68,
        mass_per_length=0.535,
        damping_ratio=damping,
        modes=modes,
    )
    case = jb.Case(
        beam,
        sensors=[jb.Sensor(0.15), jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=1.0, speed=1.0)],
        run=jb.Run(duration=6.5),
    )
    runs = np.array([(mass, speed) for speed in speeds for mass in masses])
    batches = make_batches(["loads.0.mass", "loads.0.speed"], runs, ["loads.0.mass"])
    runner = Runner(case, batches, False, 1e-3)
    steps = runner.limits.max_steps
    results = runner.block_function(np.append(steps, np.zeros_like(steps)))(0)
    peaks = results["peak_deflection"]  # speed, mass, sensor
    ratio = peaks / (masses[:, None] * np.asarray(static_peak(case, np.array([0.15, 0.3]))))
    assert ratio.min() > 0.99 and ratio.max() < 1.15


def test_errors_are_measured_with_few_steps_per_sample():
    """One or two steps per hold, which the finer runs must exceed."""
    controlled = dataclasses.replace(
        CASE,
        actuators=[jb.PointForce(0.3)],
        sensors=[jb.Sensor(0.3)],
        controller=jb.Feedback(gains=[200.0], period=0.02),
        run=jb.Run(0.5, sample_rate=50.0),
    )
    over = {"loads.0.speed": np.linspace(2.0, 6.0, 6)}
    rough, fine = (
        jb.sweep(controlled, over, progress=False, tolerance=tolerance)
        for tolerance in (1e-2, 1e-9)
    )
    error = np.max(np.abs(rough.peak_deflection / fine.peak_deflection - 1))
    assert 1e-9 < error < rough.error_estimate
