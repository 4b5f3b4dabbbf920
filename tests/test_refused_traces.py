"""What is written, or handed to other packages, refuses traced numbers in one sentence."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxbeam as jb
import jaxbeam.plot
import tuning
from jaxbeam.analysis import stability
from jaxbeam.analysis.combinations import combine
from jaxbeam.analysis.compare import compare
from jaxbeam.analysis.load_models import crossing_envelope, load_model_envelope
from jaxbeam.analysis.sections import (
    characteristic_points,
    influence_table,
    record_amplification,
)
from jaxbeam.analysis.stability import stability_margin
from jaxbeam.control.receptance_method import closed_loop_poles, receptance_feedback
from jaxbeam.model import state_space

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.3)],
    actuators=[jb.PointForce(0.3)],
    loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    run=jb.Run(0.1, 100.0),
)
MASS, RIGIDITY, GAIN = "loads.0.mass", "beam.flexural_rigidity", "controller.gains.0"
TIMES = np.linspace(0.0, 0.3, 31)
LOG = tuning.Log(TIMES, np.sin(TIMES)[:, None], ("w",), ("deflection",), ("m",), sensors=(0,))
TRAINING = tuning.LoadCases(({MASS: 0.2},))
LAW = receptance_feedback(CASE, [-9 + 99j])


def responses(case):
    """A frequency response of a case."""
    return jb.frequency_response(case, np.array([5.0, 9.0]), [("force@0.3", "velocity@0.2")])


REFUSED = {
    "amplification of a record": lambda case, _: record_amplification(jb.simulate(case)),
    "python-control, plant and loop": lambda case, path: jb.to_control(case),
    "python-control": lambda case, path: jb.state_space(case).unloaded.to_control(),
    "MATLAB": lambda case, path: jb.state_space(case).unloaded.to_mat(path / "plant.mat"),
    "file": lambda case, path: jb.save(jb.simulate(case), path / "run.csv"),
    "table": lambda case, path: jb.simulate(case).columns,
    "figure": lambda case, path: jb.simulate(case).plot(),
    "figure of a function": lambda case, path: jaxbeam.plot.plot_record(jb.simulate(case)),
    "plain data": lambda case, path: jb.api.content(jb.simulate(case)),
    "table of an envelope": lambda case, path: jb.simulate(case).envelope("moment").columns,
    "dataset of an envelope": lambda case, path: jb.simulate(case).envelope("moment").to_xarray(),
    "table of modes": lambda case, path: jb.modes(case).columns,
    "dataset of modes": lambda case, path: jb.modes(case).to_xarray(),
    "table of responses": lambda case, path: responses(case).columns,
    "dataset of responses": lambda case, path: responses(case).to_xarray(),
    "figure of responses": lambda case, path: responses(case).plot(),
    "points": lambda case, path: characteristic_points(case),
    "poles of a plant": lambda case, path: state_space.poles(case),
    "zeros of a plant": lambda case, path: state_space.zeros(case, ("force@0.3", "velocity@0.2")),
    "poles": lambda case, path: closed_loop_poles(case, LAW),
    "feedback that keeps modes": lambda case, path: receptance_feedback(case, [-9 + 99j], keep=[1]),
    "load model": lambda case, path: load_model_envelope(case, "HL-93", [0.3]),
    "crossing of a load model": lambda case, path: crossing_envelope(case, "HL-93", 2.0, [0.3]),
    "combinations": lambda case, path: combine(
        case, {"deck": {"uniform": "20 N/m"}}, {"all": {"deck": 1.35}}, [0.3]
    ),
    "influences": lambda case, path: influence_table(case),
    "margin": lambda case, path: stability_margin(case),
    "dataset": lambda case, path: jb.simulate(case).to_xarray(),
    "bound": lambda case, path: jb.bound(case, period=0.02),
    "comparison": lambda case, path: compare(case, {"feedback": jb.Feedback([9.0], period=0.01)}),
    "case file": lambda case, path: jb.save_case(case, path / "case.toml"),
    "assessment": lambda case, path: jb.assess(case, 40.0),
    "sweep": lambda case, path: jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}),
    "growth": lambda case, path: stability.growth(case),
    "fit": lambda case, path: tuning.identify(case, LOG, RIGIDITY),
    "design of experiments": lambda case, path: tuning.design_experiment(
        case, [RIGIDITY], {"loads.0.speed": (1.0, 3.0)}
    ),
    "tuning": lambda case, path: tuning.tune(case, {GAIN: (1.0, 9.0)}, TRAINING),
    "front": lambda case, path: tuning.pareto(
        case, {GAIN: (1.0, 9.0)}, TRAINING, tuning.Objective(), "effort", [1.0]
    ),
    "weighing": lambda case, path: tuning.weigh(case, LOG, (1.0, 3.0)),
    "axles": lambda case, path: tuning.weighing.weigh_axles(case, LOG, (1.0, 3.0)),
    "influences of logs": lambda case, path: tuning.weighing.model_influence_lines(case),
}
BESIDE_THE_CASE = {
    "plain numbers": lambda share: jb.api.plain({"peak": share}),
    "grid of values": lambda share: tuning.full_grid({MASS: [0.2 * share]}),
    "draws of values": lambda share: tuning.latin_hypercube({MASS: (0.2 * share, 0.4)}, 3),
    "assigned poles": lambda share: receptance_feedback(CASE, [-9 * share + 99j]),
    "period of a bound": lambda share: jb.bound(CASE, period=0.02 * share),
    "positions of a bound": lambda share: jb.bound(CASE, [0.3 * share], period=0.02),
    "speed of an assessment": lambda share: jb.assess(CASE, 40.0 * share),
    "damping of an assessment": lambda share: jb.assess(CASE, 40.0, added_damping=1e-3 * share),
    "tolerance of a sweep": lambda share: jb.sweep(
        CASE, {"loads.0.speed": [1.0]}, tolerance=1e-6 * share
    ),
    "loads of a log": lambda share: tuning.identify(
        CASE, dataclasses.replace(LOG, loads=(jb.MovingMass(0.3 * share, 2.0),)), RIGIDITY
    ),
    "bounds of a fit": lambda share: tuning.identify(CASE, LOG, {RIGIDITY: (9.0 * share, 14.0)}),
    "bounds of a tuning": lambda share: tuning.tune(CASE, {GAIN: (1.0, 9.0 * share)}, TRAINING),
    "speeds of a weighing": lambda share: tuning.weigh(CASE, LOG, (1.0 * share, 3.0)),
    "band of a modal fit": lambda share: tuning.identify_modes(LOG, band=(1.0 * share, 9.0)),
}
OF_PLANTS = (
    *("python-control, plant and loop", "python-control", "MATLAB", "table of modes"),
    *("poles of a plant", "zeros of a plant"),
    *("dataset of modes", "table of responses", "dataset of responses", "figure of responses"),
)
TRANSFORMED = {
    "grad": lambda function: jax.jvp(function, (1.0,), (1.0,)),
    "jit": lambda function: jax.jit(function)(1.0),
    "vmap": lambda function: jax.vmap(function)(np.array([0.8, 1.0])),
}


@pytest.mark.parametrize("transformed", ["jit", "vmap"])
def test_the_verdict_of_a_compiled_run_is_refused(transformed):
    def function(share):
        return jb.simulate(jb.replace(CASE, {MASS: 0.3 * share})).verdict

    with pytest.raises(ValueError, match="a verdict can be neither differentiated nor compiled"):
        TRANSFORMED[transformed](function)


@pytest.mark.parametrize("transformed", TRANSFORMED)
def test_a_traced_record_says_that_it_is_one(transformed):
    texts = []

    def function(share):
        texts.append(repr(jb.simulate(jb.replace(CASE, {MASS: 0.3 * share}))))
        return share

    TRANSFORMED[transformed](function)
    assert all("traced or of several runs" in text for text in texts)


@pytest.mark.parametrize("transformed", TRANSFORMED)
@pytest.mark.parametrize("name", REFUSED)
def test_traced_numbers_are_refused(name, transformed, tmp_path):
    address = RIGIDITY if name in OF_PLANTS else MASS

    def function(share):
        value = share * float(jb.addresses(CASE)[address])
        REFUSED[name](jb.replace(CASE, {address: value}), tmp_path)
        return share

    with pytest.raises(ValueError, match="can be neither differentiated nor compiled: call it"):
        TRANSFORMED[transformed](function)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("transformed", TRANSFORMED)
@pytest.mark.parametrize("name", BESIDE_THE_CASE)
def test_traced_numbers_beside_the_case_are_refused(name, transformed):
    def function(share):
        BESIDE_THE_CASE[name](share)
        return share

    with pytest.raises(ValueError, match="can be neither differentiated nor compiled: [a-z ]+"):
        TRANSFORMED[transformed](function)


@pytest.mark.parametrize("transformed", TRANSFORMED)
@pytest.mark.parametrize("measure", ["weighted_rms", "vibration_dose", "sperling_index"])
def test_times_of_ride_measures_are_known(measure, transformed):
    times = np.arange(400) / 200.0

    def function(share):
        return getattr(jb.ride, measure)(share * times, np.sin(50 * times))

    with pytest.raises(ValueError, match="times of ride measures must be concrete numbers"):
        TRANSFORMED[transformed](function)


@pytest.mark.parametrize("of_record", [True, False])
def test_extremes_along_the_beam_are_differentiated_where_they_are(of_record):
    case = dataclasses.replace(CASE, actuators=())

    def largest(mass):
        changed = jb.replace(case, {MASS: mass})
        if of_record:
            return jb.simulate(changed).envelope("moment").largest.max()
        return jb.envelope(changed, quantity="moment").highest.max()

    value, slope = jax.jvp(largest, (0.3,), (1.0,))
    step = 1e-3
    differences = (largest(0.3 + step) - largest(0.3 - step)) / (2 * step)
    # Positions between those of the grid, where the moment is 1 % larger, included.
    assert float(value) == pytest.approx(float(largest(0.3)), rel=1e-9)
    assert float(slope) == pytest.approx(float(differences), rel=1e-4)


@pytest.mark.parametrize("transformed", TRANSFORMED)
def test_ranges_of_a_simulator_are_known(transformed):
    def function(share):
        jb.Simulator(CASE, {MASS: (0.1 * share, 0.4)})
        return share

    with pytest.raises(ValueError, match="make it outside of jax.jit, vmap and grad"):
        TRANSFORMED[transformed](function)


def test_a_law_of_receptances_is_differentiated_with_its_controller():
    def gain(rigidity):
        case = jb.replace(CASE, {RIGIDITY: rigidity})
        velocity = dataclasses.replace(CASE, sensors=(jb.Sensor(0.3), jb.Sensor(0.3, "velocity")))
        return receptance_feedback(case, [-9 + 99j]).controller(velocity).gains[0, 0]

    slope = jax.jvp(gain, (11.68,), (1.0,))[1]
    assert slope == pytest.approx((gain(11.69) - gain(11.67)) / 0.02, rel=1e-5)


@pytest.mark.parametrize("address", ["supports.0.position", "loads.0.speed"])
def test_extremes_at_supports_and_loads_move_with_them(address):
    """The place of an extreme at a kink of the moments has a derivative, too."""
    case = dataclasses.replace(
        CASE, actuators=(), supports=(jb.Support(0.37),), run=jb.Run(0.28, 200.0)
    )

    def extremes(number):
        found = jb.simulate(jb.replace(case, {address: number})).envelope("moment")
        return jax.numpy.stack([found.smallest.min(), found.largest.max()])

    value = float(jb.addresses(case)[address])
    slopes, step = jax.jvp(extremes, (value,), (1.0,))[1], 1e-4 * value
    differences = (extremes(value + step) - extremes(value - step)) / (2 * step)
    np.testing.assert_allclose(slopes, differences, rtol=3e-3)
    # Of a place that did not move, as what `vmap` wraps was taken for unknown.
    np.testing.assert_allclose(jax.jacfwd(extremes)(value), slopes, rtol=1e-9)


def test_extremes_at_a_support_on_the_grid_move_with_it_under_jit():
    """Half of the slope was that at the point of the grid, which does not move."""
    case = dataclasses.replace(CASE, actuators=(), supports=(jb.Support(0.36),))
    simulator = jb.Simulator(case, {"supports.0.position": (0.34, 0.38)})

    def smallest(place):
        return simulator([place]).envelope("moment").smallest.min()

    differences = (smallest(0.3601) - smallest(0.3599)) / 2e-4
    np.testing.assert_allclose(jax.jit(jax.grad(smallest))(0.36), differences, rtol=3e-3)
