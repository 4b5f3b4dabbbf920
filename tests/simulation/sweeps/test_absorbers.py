"""Peaks of strokes and forces of absorbers in sweeps: against scipy, single runs, every engine."""

import dataclasses

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize_scalar

import jaxbeam as jb
from jaxbeam.cli.commands.sweep import _absorber_lines
from jaxbeam.files.tables import sweep_columns
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.sweeps.computation import StrokeWarning
from jaxbeam.simulation.sweeps.specification import SweepSpecification
from tests.simulation.test_absorbers import BRIDGE, ROW_AND_MASS, first_principles

PEAKS = "peak_stroke", "peak_absorber_force"
ABSORBERS = [
    jb.Absorber(9.0, mass=2000.0, stiffness=1e6, damping=9e3, inertance=1500.0),
    jb.Absorber(14.0, mass=1500.0, stiffness=9e5, damping=2e3),
    jb.Absorber(
        20.0, mass=900.0, stiffness=1e6, damping=3e3, inertance=300.0, ground_inertance=400.0
    ),
]
ENGINES = {"C": True, "XLA or NumPy": False}

pytestmark = pytest.mark.usefixtures("c_integrator")


def case_under(load, absorbers=ABSORBERS, duration=1.2, **parts):
    return jb.Case(
        dataclasses.replace(BRIDGE, modes=3),
        sensors=[jb.Sensor(12.5), jb.Sensor(9.0, "acceleration")],
        loads=[load],
        absorbers=absorbers,
        run=jb.Run(duration, sample_rate=20.0),
        **parts,
    )


def swept(monkeypatch, engine, case, axes):
    monkeypatch.setattr(native_peaks, "available", lambda: ENGINES[engine])
    assert native_peaks.chosen_for(case, 1) == ENGINES[engine]
    return jb.sweep(case, axes, progress=False)


def refined(times, values, rates):
    """Largest absolute values (column,) of curves through samples with their rates."""
    found = []
    for value, rate in zip(values.T, rates.T, strict=True):
        curve, top = CubicHermiteSpline(times, value, rate), int(np.argmax(np.abs(value)))
        around = times[max(top - 1, 0)], times[min(top + 1, len(times) - 1)]
        peak = minimize_scalar(lambda t: -abs(curve(t)), bounds=around, method="bounded")  # noqa: B023
        found.append(max(-peak.fun, np.abs(value).max()))
    return np.array(found)


@pytest.mark.parametrize("engine", ENGINES)
def test_strokes_against_scipy(monkeypatch, engine):
    speeds, times = [30.0, 41.0], np.linspace(0.0, 1.2, 4801)
    case = case_under(jb.MovingForce(force=2e5, speed=30.0))
    found = swept(monkeypatch, engine, case, {"loads.0.speed": speeds})
    for speed, one in zip(speeds, found.peak_stroke.values, strict=True):
        own = jb.replace(case, {"loads.0.speed": speed})
        amplitudes, heights, places = first_principles(own, times)
        strokes = heights - amplitudes @ places.T
        assert one == pytest.approx(
            refined(times, strokes, np.gradient(strokes, times, axis=0, edge_order=2)), rel=1e-6
        )


@pytest.mark.parametrize("seed", range(9))
def test_peaks_are_those_of_single_runs(monkeypatch, seed):
    """Random absorbers under a mass, an oscillator or a row, on a level road or a rough one."""
    random = np.random.default_rng(seed)
    absorbers = [
        jb.Absorber(
            random.uniform(5.0, 20.0),
            mass=random.uniform(1e3, 4e3),
            frequency=random.uniform(2.0, 9.0),
            damping_ratio=random.uniform(0.01, 0.2),
            inertance=random.choice([0.0, 900.0]),
            ground_inertance=random.choice([0.0, 500.0]),
        )
        for _ in range(random.integers(1, 4))
    ]
    if seed == 8:
        load = ROW_AND_MASS[0]
    elif seed % 2:
        load = jb.MovingMass(mass=6e3, speed=35.0)
    else:
        load = jb.Oscillator(mass=9e3, stiffness=2e6, damping=3e4, speed=35.0)
    road = jb.profiles.SineProfile(amplitude=1e-3, wavelength=6.0) if seed % 4 < 2 else None
    case = case_under(load, absorbers, profile=road)
    axes = {"loads.0.speed": [35.0, 28.0], "absorbers.0.damping_ratio": [0.05, 0.1]}
    times = np.linspace(0.0, 1.2, 6001)
    by_engine = [swept(monkeypatch, engine, case, axes) for engine in ENGINES]
    for name in PEAKS:
        assert by_engine[0][name].values == pytest.approx(by_engine[1][name].values, rel=1e-7)
    for i, speed in enumerate(axes["loads.0.speed"]):
        numbers = {"loads.0.speed": speed, "absorbers.0.damping_ratio": 0.1}
        record = jb.simulate(jb.replace(case, numbers), times=times)
        for name, tolerance in zip(PEAKS, (1e-9, 3e-8), strict=True):  # each in its own steps
            peaks = by_engine[0][name].values[i, 1]
            assert getattr(record, name) == pytest.approx(peaks, rel=tolerance)
        strokes = refined(times, record.stroke, record.stroke_rate)
        assert by_engine[0].peak_stroke.values[i, 1] == pytest.approx(strokes, rel=1e-6)
        forces = np.abs(record.absorber_force).max(axis=0)  # at samples, which may miss the peak
        assert by_engine[0].peak_absorber_force.values[i, 1] == pytest.approx(forces, rel=1e-4)


def test_many_speeds_by_compiled_programs(monkeypatch):
    axes = {"loads.0.speed": np.linspace(25.0, 40.0, 10), "absorbers.1.position": [13.5, 14.0]}
    case = case_under(jb.MovingMass(mass=6e3, speed=35.0))
    by_engine = [swept(monkeypatch, engine, case, axes) for engine in ENGINES]
    few = swept(monkeypatch, "XLA or NumPy", case, axes | {"loads.0.speed": [25.0, 40.0]})
    for name in PEAKS:
        c, xla = (one[name].values for one in by_engine)
        assert c == pytest.approx(xla, rel=1e-8)
        assert xla[[0, -1]] == pytest.approx(few[name].values, rel=1e-7)


def test_groups_of_sensors_and_stores(monkeypatch, tmp_path):
    case = case_under(jb.MovingMass(mass=6e3, speed=35.0))
    axes = {"loads.0.speed": [28.0, 35.0]}
    whole = jb.sweep(case, axes, progress=False, store=tmp_path / "runs.zarr")
    monkeypatch.setattr(SweepSpecification, "sensor_groups", [[1], [0]])
    groups = jb.sweep(case, axes, progress=False)
    for name in (*PEAKS, "peak_deflection", "peak_acceleration", "peak_time"):
        assert groups[name].values == pytest.approx(whole[name].values, rel=1e-7, nan_ok=True)
    assert whole.peak_stroke.dims == ("loads.0.speed", "absorber")
    assert whole.peak_stroke.units == "m" and whole.peak_absorber_force.units == "N"


def test_strokes_above_the_largest_allowed_are_warned_of():
    absorber = dataclasses.replace(ABSORBERS[0], max_stroke=1e-4)
    case = case_under(jb.MovingMass(mass=6e3, speed=35.0), [absorber])
    with pytest.warns(StrokeWarning, match="absorber 0 exceeds its max_stroke in 2 of 2 runs"):
        jb.sweep(case, {"loads.0.speed": [28.0, 35.0]}, progress=False)
    with pytest.warns(StrokeWarning, match="absorber 0 exceeds its max_stroke in 1 of 2 runs"):
        jb.sweep(case, {"absorbers.*.max_stroke": [1e-4, 1.0]}, progress=False)


def test_tables_have_strokes_and_forces():
    case = case_under(jb.MovingMass(mass=6e3, speed=35.0))
    runs = jb.sweep(case, {"loads.0.speed": [28.0, 35.0]}, progress=False)
    columns = sweep_columns(runs)
    for words, name in (("stroke (m)", "peak_stroke"), ("force (N)", "peak_absorber_force")):
        found = columns[f"absorber 2 peak {words}"]
        np.testing.assert_array_equal(found, runs[name].values[:, 2])
    lines = _absorber_lines(runs, ["loads.0.speed"])
    largest = runs.peak_absorber_force.values[:, 2]
    speed = [28, 35][int(np.argmax(largest))]
    assert lines[-1].split() == ["2", "force", "(N)", f"{largest.max():.6g}", f"{speed}"]
