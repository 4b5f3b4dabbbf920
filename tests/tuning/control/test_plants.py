"""Plants drawn from a fit, and controllers designed for the nominal plant."""

import dataclasses

import numpy as np
import pytest
import scipy.stats

import jaxbeam as jb
import tuning
from tests.tuning.small_rig import GAIN, RIGIDITY, rig
from tests.tuning.stand_in import CASE, fit
from tuning.control.objective import with_fixed_design
from tuning.control.run_set import make_run_set
from tuning.fit.uncertainty.posterior import Posterior


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
    other = dataclasses.replace(CASE, loads=(jb.MovingMass(mass=0.1, speed=2.0),))
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
        rig(), {GAIN: (500.0, 20000.0)}, loads,
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
