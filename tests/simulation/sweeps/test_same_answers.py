"""Every way of computing a run against every other: the same case has one answer.

Single runs of known and of traced numbers, envelopes, sweeps of peaks in XLA, in C and in NumPy,
sweeps of histories. Runs end at their durations, so peaks do not depend on the sample rate.
"""

import contextlib
import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import common_plan, integration_plan, sample_times
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.sweeps import blocks
from jaxbeam.simulation.sweeps.blocks import Runner
from tests.strategies import numbers

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=3),
    sensors=[jb.Sensor(0.3), jb.Sensor(0.15)],
    loads=[
        jb.MovingMass(mass=0.4, speed=2.5),
        jb.MovingForce(mass=0.2, speed=-2.0, entry_time=0.02),
    ],
    run=jb.Run(duration=0.1, sample_rate=150),
)
RUNS = 6
TOLERANCE = 1e-6  # of peaks; both ways of computing have errors of some 1e-7

# Runs that end while the beam is deflected more and more, as often as not, and 5 to 100 samples.
RANDOM_RUNS = st.lists(
    st.fixed_dictionaries(
        {
            "loads.0.mass": numbers(0.05, 2.0),
            "loads.0.speed": numbers(0.8, 9.0),
            "loads.1.entry_time": numbers(0.0, 0.1),
            "beam.flexural_rigidity": numbers(5.0, 40.0),
            "run.duration": numbers(0.02, 0.4),
        }
    ),
    min_size=RUNS,
    max_size=RUNS,
)


pytestmark = pytest.mark.usefixtures("c_integrator")


@contextlib.contextmanager
def same_steps():
    """A context in which all sweeps of the same runs take the steps that the first one chooses.

    Steps follow from differences of peaks, whose rounding is another in C than in XLA.
    """
    with pytest.MonkeyPatch.context() as patch:
        first, choose = [], Runner.choose_step_sizes

        def chosen(runner):
            first[:] = first or [choose(runner)]
            return first[0]

        patch.setattr(Runner, "choose_step_sizes", chosen)
        yield


def swept(case, runs, native: bool = False, known: bool = False, **options) -> np.ndarray:
    """Peaks (run, sensor) of a sweep: in C if `native`, in NumPy if `known`, else in XLA."""
    over = {address: [run[address] for run in runs] for address in runs[0]}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_peaks, "available", lambda: native)
        if known:
            patch.setattr(Runner, "_compile", None)
        else:
            patch.setattr(blocks, "suits_numpy", lambda *_: False)
        assert native_peaks.chosen_for(case, 1) == (native and case.controller is None)
        found = jb.sweep(case, over, paired=True, progress=False, **options)
    return found.peak_deflection.values


def single(case, run, rate: float = 150.0) -> np.ndarray:
    """Peaks of a single run of known numbers."""
    return jb.simulate(jb.replace(case, {**run, "run.sample_rate": rate})).peak_deflection


@settings(max_examples=2, phases=[Phase.generate])
@given(runs=RANDOM_RUNS, rate=numbers(30.0, 1000.0))
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_single_runs_envelopes_and_sweeps_of_known_numbers(runs, rate):
    with same_steps():
        expected = swept(CASE, runs)
        assert_allclose(swept(CASE, runs, native=True), expected, rtol=1e-10)
        assert_allclose(swept(CASE, runs, known=True), expected, rtol=1e-10)
    assert_allclose(swept(CASE, runs, native=True), expected, rtol=TOLERANCE)
    for run, peaks in zip(runs, expected, strict=True):
        assert_allclose(single(CASE, run), peaks, rtol=TOLERANCE)
        assert_allclose(single(CASE, run, rate), peaks, rtol=TOLERANCE)
        low, high = jb.envelope(jb.replace(CASE, run), CASE.sensor_positions)
        assert_allclose(np.maximum(-low, high), peaks, rtol=TOLERANCE)


@settings(max_examples=1, phases=[Phase.generate])
@given(runs=RANDOM_RUNS)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_traced_runs_and_sweeps_of_histories(runs):
    """Their durations are not traced, as the number of samples depends on them: 0.1 s."""
    runs = [{name: run[name] for name in run if name != "run.duration"} for run in runs]
    case = jb.replace(CASE, {"run.sample_rate": 33.0})
    assert sample_times(case)[-1] < 0.095
    names = tuple(runs[0])
    plan = common_plan([integration_plan(jb.replace(case, run)) for run in runs])
    plan = dataclasses.replace(plan, error=0.0, substeps=64)
    values = np.array([[run[name] for name in names] for run in runs])
    traced = jax.jit(
        jax.vmap(
            lambda row: (
                jb.simulate(
                    jb.replace(case, dict(zip(names, row, strict=True))), plan=plan
                ).peak_deflection
            )
        )
    )(values)
    expected = swept(case, runs)
    assert_allclose(traced, expected, rtol=TOLERANCE)
    for known in (False, True):
        of_histories = swept(case, runs, known=known, histories=True)
        assert_allclose(of_histories, expected, rtol=TOLERANCE)
    for run, peaks in zip(runs, expected, strict=True):
        assert_allclose(single(case, run, 33.0), peaks, rtol=TOLERANCE)


@pytest.mark.parametrize("period", [None, 0.007])
def test_controlled_runs(period):
    """The controller acts to the end of the run, after the last sample too."""
    controlled = dataclasses.replace(
        jb.replace(CASE, {"run.duration": 0.09, "run.sample_rate": 33.0}),
        actuators=[jb.PointForce(0.2)],
        sensors=CASE.sensors[:1],
        controller=jb.Feedback(gains=[300.0], period=period),
    )
    runs = [{"loads.0.mass": mass, "loads.0.speed": v} for mass, v in [(0.4, 2.5), (0.9, 4.0)]]
    expected = swept(controlled, runs)
    if period is not None:
        assert_allclose(swept(controlled, runs, known=True), expected, rtol=TOLERANCE)
    for run, peaks in zip(runs, expected, strict=True):
        assert_allclose(single(controlled, run, 33.0), peaks, rtol=TOLERANCE)
        assert_allclose(single(controlled, run, 1000.0), peaks, rtol=TOLERANCE)
        at_samples = jb.simulate(jb.replace(controlled, run)).times[-1]
        assert at_samples < 0.0899
    record = jb.simulate(jb.replace(controlled, runs[0]))
    assert record.peak_time[0] == pytest.approx(0.09, rel=1e-12)


def test_runs_shorter_than_a_sample_interval_end_at_their_duration():
    case = jb.replace(CASE, {"run.duration": 0.03, "run.sample_rate": 10.0})
    record = jb.simulate(case)
    np.testing.assert_array_equal(record.times, [0.0, 0.03])
    assert_allclose(record.peak_deflection, single(CASE, {"run.duration": 0.03}), rtol=TOLERANCE)


def test_given_times_end_the_run():
    times = np.linspace(0.0, 0.05, 11)
    record = jb.simulate(CASE, times)
    assert_allclose(record.peak_deflection, single(CASE, {"run.duration": 0.05}), rtol=TOLERANCE)
