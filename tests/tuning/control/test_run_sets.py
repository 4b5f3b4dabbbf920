"""Tuning with vehicles and profiles as load cases, in training and held-out runs."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import jaxbeam as jb
import tuning
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import simulate_histories
from tests.tuning.small_rig import CASE as PLANT_CASE, GAIN as PLANT_GAIN, RIGIDITY, fit, rig
from tuning.control import run_set
from tuning.control.objective import with_fixed_design
from tuning.control.run_set import make_run_set, run_case, run_cases
from tuning.fit.uncertainty import Posterior

GAIN = "controller.gains.0"
CAR = {
    "body_mass": 0.4,
    "axle_mass": 0.1,
    "suspension_stiffness": 300.0,
    "suspension_damping": 2.0,
    "tyre_stiffness": 4000.0,
    "tyre_damping": 1.0,
}


def case() -> jb.Case:
    """Small rig under a quarter car on a random road."""
    car = jb.QuarterCar(**CAR, speed=2.0, start_position=-0.1)
    road = jb.profiles.ISO8608Profile(
        road_class="A", scale=0.02, lowest_wavenumber=1.0, highest_wavenumber=8.0, waves=6,
        switch_on=[-0.1, -0.05],
    )  # fmt: skip
    return dataclasses.replace(rig(), loads=(car,), profile=road)


TRAINING = tuning.full_grid({"loads.0.body_mass": [0.3, 0.5], "profile.seed": [0, 1]})
HELD_OUT = tuning.full_grid(
    {"loads.0.suspension_stiffness": [200.0], "profile.scale": [0.03], "profile.seed": [2]}
)


def test_runs_have_their_own_vehicles_and_roads():
    cases = run_cases(case(), TRAINING)
    assert [float(own.loads[0].body_mass) for own in cases] == [0.3, 0.3, 0.5, 0.5]
    for own, run in zip(cases, TRAINING, strict=True):
        expected = dataclasses.replace(case().profile, seed=int(run["profile.seed"]))
        heights = own.profile.heights(np.linspace(-0.2, 0.8, 50))
        np.testing.assert_allclose(heights, expected.heights(np.linspace(-0.2, 0.8, 50)))
    assert run_case(case(), {"profile.seed": 3.0}).profile.seed == 3
    with pytest.raises(ValueError, match="profile.seed takes a whole number, not 0.5"):
        run_case(case(), {"profile.seed": 0.5})
    longer = dataclasses.replace(case(), loads=(jb.Axles(offsets=[0.0], forces=[1.0], speed=2.0,
                                                         spacing=0.1),))  # fmt: skip
    with pytest.raises(ValueError, match="differ in loads.0.count cannot be simulated together"):
        run_cases(longer, tuning.full_grid({"loads.0.count": [1, 2]}))


def test_load_cases_are_read_from_a_file(tmp_path):
    path = tmp_path / "cases.toml"
    path.write_text(
        '[training]\n"loads.0.body_mass" = [0.3, 0.5]\n"profile.seed" = [0, 1]\n'
        '[held_out]\n"profile.seed" = [2]\n'
    )
    read = tuning.read_load_cases(path)
    assert read.training == TRAINING and read.held_out == ({"profile.seed": 2.0},)


def test_contact_forces_of_a_run_are_those_on_the_beam():
    """What the road does to a wheel on the ground is nothing that a controller can change."""
    own = dataclasses.replace(run_case(case(), HELD_OUT[0]), controller=None)
    times = np.linspace(0.0, 0.5, 101)
    plan = integration_plan(own, times)
    found = simulate_histories(own, times, plan, np.array([0.25])).contact_force[:, 0]
    record = jb.simulate(own, times, plan)
    on_beam = np.isfinite(record.load_position[:, 0])
    assert 0 < on_beam.sum() < 101
    np.testing.assert_array_equal(found, np.where(on_beam, record.contact_force[:, 0], 0.0))


def test_a_gain_is_tuned_on_vehicles_and_checked_on_others():
    cases = tuning.LoadCases(TRAINING[::2], HELD_OUT)
    stable = tuning.StabilityConstraint(max_real_part=0.5, instants=2)
    free = {GAIN: (0.0, 20000.0)}
    tuned = tuning.tune(
        case(), free, cases, steps=6, stable=stable, least_peaks=False, progress=False
    )
    training, held_out = tuned.run_sets
    assert [run["profile.seed"] for run in held_out.runs] == [2.0]
    assert tuned.stability_violation == 0.0
    assert np.max(training.peaks_after / training.uncontrolled_peaks) < np.max(
        training.peaks_before / training.uncontrolled_peaks
    )
    own = jb.replace(run_case(case(), HELD_OUT[0]), {GAIN: float(tuned.values[0])})
    record = jb.simulate(own)
    plain = jb.simulate(dataclasses.replace(own, controller=None))
    assert held_out.peaks_after[0] == pytest.approx(float(record.peak_deflection[0]), rel=1e-3)
    assert held_out.uncontrolled_peaks[0] == pytest.approx(
        np.abs(np.asarray(plain.deflection)).max(), rel=1e-3
    )


# Sets of runs: those without control in groups that fit into memory.

BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2)
CASE = jb.Case(
    BEAM,
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.2, speed=2.0)],
    run=jb.Run(0.4, sample_rate=200.0),
)


def test_runs_in_groups_have_the_same_histories(monkeypatch):
    cases = [jb.replace(CASE, {"loads.0.mass": mass}) for mass in (0.1, 0.2, 0.3)]
    wanted = np.arange(80) / 200.0, np.array([0.2, 0.3]), ()
    expected = run_set._uncontrolled_histories(cases, *wanted)
    plan = run_set._integration_plan(cases)
    run_bytes = 8.0 * run_set.STATE_COPIES * 80 * plan.substeps * 4
    monkeypatch.setattr(run_set, "block_memory", lambda: 2.5 * run_bytes)
    assert run_set.runs_at_once(cases[0], wanted[0], plan) == 2
    assert run_set.runs_at_once(cases[0], np.arange(1e5), plan) == 1
    monkeypatch.setattr(run_set, "MAX_UNCOMPILED_RUNS", 0)
    found = run_set._uncontrolled_histories(cases, *wanted)
    assert found.deflection.shape == expected.deflection.shape == (3, 80, 2)
    assert_allclose(found.deflection, expected.deflection, atol=1e-12)


# Number of XLA threads in a process that imports tuning: with two, XLA deadlocks.

COUNT = """
import pathlib
import jaxbeam, tuning
import jax.numpy as jnp
jnp.ones(3).block_until_ready()
names = [(task / "comm").read_text() for task in pathlib.Path("/proc/self/task").iterdir()]
print(sum("XLAEigen" in name for name in names))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
@pytest.mark.parametrize(
    ("requested", "least", "most"), [(None, 8, os.cpu_count() or 8), (3, 3, 3)]
)
def test_xla_has_at_least_eight_threads_unless_set_otherwise(requested, least, most):
    environment = {name: value for name, value in os.environ.items() if name != "PJRT_NPROC"}
    if requested is not None:
        environment["PJRT_NPROC"] = str(requested)
    line = [sys.executable, "-c", COUNT]
    counted = subprocess.run(line, capture_output=True, text=True, env=environment, check=True)
    assert least <= int(counted.stdout) <= max(least, most)


# Plants drawn from a fit, and controllers designed for the nominal plant.


@pytest.fixture(scope="module")
def identified_fit():
    return fit()


def drawn_plants(identified_fit, count=4000, seed=0):
    rows = tuning.control.draw_plants(identified_fit, count, seed)
    return np.array([list(row.values()) for row in rows])


def test_plants_have_the_covariance_of_the_fit(identified_fit):
    rows = drawn_plants(identified_fit)
    scatter = identified_fit.errors / np.sqrt(len(rows))
    assert np.all(np.abs(rows.mean(axis=0) - identified_fit.values) < 4 * scatter)
    np.testing.assert_allclose(rows.std(axis=0), identified_fit.errors, rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(rows.T), identified_fit.correlation, atol=0.06)
    np.testing.assert_array_equal(drawn_plants(identified_fit, 3), drawn_plants(identified_fit, 3))
    assert not np.array_equal(
        drawn_plants(identified_fit, 3), drawn_plants(identified_fit, 3, seed=1)
    )


def test_plants_have_students_distribution_for_few_samples(identified_fit):
    """95 % of the plants lie in the 95 % interval of the fit."""
    few = dataclasses.replace(identified_fit, degrees_of_freedom=3.0)
    rows = drawn_plants(few)[:, 2]
    inside = np.mean((rows > few.intervals[2, 0]) & (rows < few.intervals[2, 1]))
    assert inside == pytest.approx(0.95, abs=0.015)
    standard = (rows - few.values[2]) / few.errors[2]
    assert scipy.stats.kstest(standard, scipy.stats.t(3).cdf).pvalue > 1e-3


def test_plants_are_within_bounds(identified_fit):
    low = float(identified_fit.values[1])
    parameters = list(identified_fit.parameters)
    parameters[1] = dataclasses.replace(parameters[1], low=low)
    bounded = dataclasses.replace(identified_fit, parameters=parameters)
    assert drawn_plants(bounded, 300)[:, 1].min() >= low
    parameters[1] = dataclasses.replace(
        parameters[1], low=low + 9 * float(identified_fit.errors[1])
    )
    with pytest.raises(ValueError, match="lie within the bounds of the fit"):
        drawn_plants(dataclasses.replace(identified_fit, parameters=parameters), 5)


def test_draws_of_a_posterior_are_plants():
    draws = np.random.default_rng(0).normal(size=(2, 50, 2))
    posterior = Posterior(["beam.length", "loads.0.mass"], draws, np.ones(2), np.ones(2), 0)
    rows = tuning.control.draw_plants(posterior, 100)
    assert sorted(row["beam.length"] for row in rows) == sorted(draws[..., 0].ravel())
    assert set(rows[0]) == {"beam.length"}
    with pytest.raises(ValueError, match="101 plants need as many draws; the posterior has 100"):
        tuning.control.draw_plants(posterior, 101)


def test_fits_from_which_no_plants_can_be_drawn_are_refused(identified_fit):
    unidentifiable = dataclasses.replace(identified_fit, errors=np.array([1.0, np.inf, 1.0]))
    with pytest.raises(
        ValueError, match="not identifiable from the data: beam.damping_ratio; to draw plants"
    ):
        tuning.control.draw_plants(unidentifiable, 3)
    with pytest.raises(ValueError, match="must be 1 or more, not 0"):
        tuning.control.draw_plants(identified_fit, 0)
    loads = Posterior(["logs.0.loads.0.mass"], np.ones((1, 5, 1)), np.ones(1), np.ones(1), 0)
    with pytest.raises(ValueError, match="no parameter of the plant was identified"):
        tuning.control.draw_plants(loads, 3)


def test_a_case_with_the_identified_plant(identified_fit):
    other = dataclasses.replace(PLANT_CASE, loads=(jb.MovingMass(mass=0.1, speed=2.0),))
    changed = tuning.control.with_identified_plant(other, identified_fit)
    assert float(changed.beam.flexural_rigidity) == identified_fit.values[0]
    assert float(changed.sensors[0].offset) == identified_fit.values[2]
    assert float(changed.loads[0].mass) == 0.1


def test_runs_are_simulated_on_every_plant():
    cases = tuning.LoadCases(({"a": 1.0}, {"a": 2.0}), ({"a": 3.0},))
    load_cases = cases.across(({"b": 5.0}, {"b": 6.0}), ({"b": 7.0},))
    assert load_cases.training == tuple({"a": a, "b": b} for a in (1.0, 2.0) for b in (5.0, 6.0))
    assert load_cases.held_out == ({"a": 3.0, "b": 7.0},)
    assert cases.across(({"b": 5.0},)).held_out == cases.held_out


WEIGHTS = {"state_weight": [1e4, 1.0], "command_weight": [1e-3]}


def test_controllers_are_designed_for_the_nominal_plant():
    """On a softer beam the commands are those of the gains designed for the stiffer one."""
    law = jb.LQR(**WEIGHTS, period=0.01)
    gain = np.asarray(law.time_invariant_gain(jb.state_space(rig(law))))
    soft = {RIGIDITY: 10.0}
    fixed = jb.StateFeedback(gain=gain.reshape(1, -1), period=0.01)
    expected = jb.simulate(jb.replace(rig(fixed), soft))
    run_set = make_run_set(rig(law), [soft])
    assert float(run_set.nominal[RIGIDITY]) == 13.211
    record = run_set.records({})[0]
    np.testing.assert_allclose(record.command, expected.command, rtol=1e-6, atol=1e-9)
    designed_for_soft = jb.simulate(jb.replace(rig(law), soft))
    assert np.abs(np.asarray(designed_for_soft.command) - record.command).max() > 1e-3
    case = rig(law)
    assert with_fixed_design(case, {}, run_set.plan.shapes.layout) is case


def test_tuning_for_the_worst_of_several_plants():
    """Peaks in the result are those of a simulation of each plant."""
    identified = Posterior(
        [RIGIDITY], np.linspace(11.0, 15.0, 9).reshape(1, 9, 1), np.ones(1), np.ones(1), 0
    )
    loads = tuning.LoadCases(({"loads.0.mass": 0.3},), ({"loads.0.mass": 0.4},))
    tuned = tuning.tune(
        rig(), {PLANT_GAIN: (500.0, 20000.0)}, loads,
        plant=identified, plants=2, steps=8, least_peaks=False, progress=False,
    )  # fmt: skip
    training, held_out = tuned.run_sets
    assert float(tuned.case.beam.flexural_rigidity) == pytest.approx(13.0)
    plants = [run[RIGIDITY] for run_set in tuned.run_sets for run in run_set.runs]
    assert len(set(plants)) == 4 and all(11.0 <= value <= 15.0 for value in plants)
    relative = training.peaks_after / training.uncontrolled_peaks
    assert training.objective[1] == pytest.approx(relative.max(), rel=1e-3)
    run = held_out.runs[1]
    record = jb.simulate(jb.replace(tuned.case, run))
    assert held_out.peaks_after[1] == pytest.approx(float(record.peak_deflection[0]), rel=1e-4)
    plain = jb.simulate(dataclasses.replace(record.case, controller=None))
    peak = np.abs(plain.deflection).max()  # at samples, like the peak that it is compared with
    assert held_out.uncontrolled_peaks[1] == pytest.approx(peak, rel=1e-3)
