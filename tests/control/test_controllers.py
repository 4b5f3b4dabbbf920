"""Closed loops: records, divergence, batches and derivatives.

What of the loads the designs of laws depend on: no more than they declare, for every kind.
"""

import dataclasses
import itertools
import json
import logging
import re
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.case import unit_at, value_at
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.validation import check_case
from jaxbeam.cli import main
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.closed_loop import closed_loop, loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, sample_times, static_shapes
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.sweeps.computation import FailedRunsWarning
from tests.differences import central
from tests.export.cases import CASES
from tests.loop_as_oracle import expected

BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2)
MASS = jb.MovingMass(mass=0.4, speed=2.5)
TIMES = np.linspace(0.0, 0.3, 31)
HELD = jb.Case(
    BEAM,
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0, limits=[-0.3, 0.35])],
    sensors=[jb.Sensor(0.25, filter=jb.Filter(60.0, 3))],
    loads=[MASS],
    controller=jb.Feedback([600.0], period=2e-3, delay=5e-4),
    run=jb.Run(0.3, sample_rate=100.0),
    title="a loop",
)


def plan_for(case: jb.Case, times=TIMES, substeps: int = 1) -> IntegrationPlan:
    return IntegrationPlan(
        static_shapes(case), substeps, 0, False, 0.0, loop_schedule(case, np.asarray(times))
    )


@pytest.fixture(scope="module")
def plan():
    return plan_for(HELD)


@pytest.fixture(scope="module")
def record(plan):
    return jb.simulate(HELD, TIMES, plan)


def test_record_of_command_saturation_and_effort(record):
    truth = expected(HELD, TIMES).command
    assert_allclose(record.command, truth, rtol=0, atol=1e-10)
    assert_array_equal(record.saturated, truth == 0.35)
    assert 0 < np.sum(record.saturated) < TIMES.size
    assert_allclose(record.effort, np.trapezoid(truth**2, TIMES, axis=0), rtol=1e-9)
    assert np.isnan(record.diverged_time)
    assert record.verdict.startswith("every load presses on the beam throughout")


def test_record_with_a_controller_in_a_file(record, tmp_path):
    record.to_netcdf(tmp_path / "loop.nc")
    restored = jb.read_record(tmp_path / "loop.nc")
    assert jax.tree.structure(restored) == jax.tree.structure(record)
    jax.tree.map(assert_array_equal, restored, record)
    dataset = record.to_xarray()
    assert dataset.command.dims == ("time", "actuator")
    assert json.loads(dataset.attrs["case"])["controller"]["gains"] == [600.0]


# Divergence

UNBOUNDED = dataclasses.replace(HELD, actuators=(jb.PointForce(0.3),), sensors=(jb.Sensor(0.25),))
GAINS, MASSES = np.array([100.0, 1e5, 700.0]), np.array([0.1, 0.4])


def test_verdict_of_a_diverging_loop():
    """No exception and no warning."""
    record = jb.simulate(jb.replace(UNBOUNDED, {"controller.gains.0": 1e5}))
    diverged = float(record.diverged_time)
    assert 0 < diverged < 0.3
    growth = f"the deflection has grown beyond all bounds by t = {diverged:.4g}"
    assert f"the control loop diverges: {growth}" in record.verdict
    before = np.asarray(record.times) < diverged
    assert np.all(np.isfinite(record.deflection[before]))
    assert np.all(np.isnan(record.deflection[~before]))
    assert np.isnan(record.peak_deflection).all() and np.isnan(record.error_estimate)


@pytest.fixture(scope="module")
def sweep_and_compilations():
    """Sweep over gains, one of which diverges, and masses; and the programs compiled for it."""
    messages = []

    class MessageRecorder(logging.Handler):
        def emit(self, record):
            messages.append(record.getMessage())

    logger, handler = logging.getLogger("jax"), MessageRecorder()
    logger.addHandler(handler)
    jax.config.update("jax_log_compiles", True)  # in all threads; its context is for one
    try:
        over = {"controller.gains.0": GAINS, "loads.0.mass": MASSES}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FailedRunsWarning)
            dataset = jb.sweep(UNBOUNDED, over, progress=False)
    finally:
        jax.config.update("jax_log_compiles", False)
        logger.removeHandler(handler)
    return dataset, [message for message in messages if "Compiling jit(integrate_block" in message]


def test_only_diverging_runs_of_a_sweep_fail(sweep_and_compilations):
    dataset, compilations = sweep_and_compilations
    assert dataset.attrs["failed_runs"] == 2
    assert_array_equal(dataset.failed, [[False, False], [True, True], [False, False]])
    assert np.isnan(dataset.peak_deflection[1]).all()
    assert not compilations  # a small sweep takes its steps in NumPy
    plan = plan_for(UNBOUNDED)
    for i in (0, 2):
        for j in range(2):
            values = {"controller.gains.0": GAINS[i], "loads.0.mass": MASSES[j]}
            single_run = jb.simulate(jb.replace(UNBOUNDED, values), TIMES, plan)
            assert_allclose(dataset.peak_deflection[i, j], single_run.peak_deflection, rtol=1e-7)


def test_batch_of_gains_equals_single_runs():
    plan = plan_for(UNBOUNDED)

    def deflection(gain):
        case = jb.replace(UNBOUNDED, {"controller.gains.0": gain})
        return jb.simulate(case, TIMES, plan).deflection

    batched = jax.jit(jax.vmap(deflection))(jnp.asarray(GAINS))
    for gain, found in zip(GAINS, batched, strict=True):
        # Rounding grows where the loop diverges.
        assert_allclose(found, deflection(gain), rtol=1e-12 if gain < 1e4 else 1e-6, atol=1e-15)
    assert np.isnan(batched[1]).any() and np.isfinite(batched[np.array([0, 2])]).all()


# Derivatives

FREE = {
    "controller.gains.0": 600.0,
    "sensors.0.filter.cutoff": 60.0,
    "actuators.0.force_per_volt": 4.6,
    "actuators.0.stiffness": 500.0,
    "actuators.0.damping": 8.0,
    "actuators.0.bandwidth": 400.0,
    "actuators.0.limits.1": 0.35,
    "loads.0.mass": 0.4,
    "loads.0.speed": 2.5,
}


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_gradients_through_filter_hold_delay_and_saturation(plan, record, derivative):
    sizes = np.array(list(FREE.values()))
    data = record.deflection + 2e-4 * np.cos(np.arange(31.0))[:, None]

    def outputs(point):
        case = jb.replace(HELD, dict(zip(FREE, point * sizes, strict=True)))
        found = jb.simulate(case, TIMES, plan)
        misfit = xp.sum(((found.deflection - data) / 1e-3) ** 2)
        return xp.stack([misfit, found.peak_deflection[0] * 1e3, found.effort[0]])

    at = jnp.ones(len(FREE))
    differences = central(outputs, np.ones(len(FREE)), step=2e-4, order=4)
    size = np.max(np.abs(differences), axis=1, keepdims=True)
    assert np.all(np.abs(differences[0]) > 1e-4 * size[0])
    found = jax.jit(derivative(outputs))(at)
    assert_allclose(found / size, differences / size, rtol=1e-6, atol=1e-8)


# Controllers in case files and on the command line, and the errors of their settings.

ACTUATOR = HELD.actuators[0]
SAMPLED = "needs a controller that samples: give controller.period"


def estimated_by(value) -> jb.LQR:
    """Regulator with something in the place of its estimator, whose class no one has checked."""
    law = jb.LQR([1.0], [1.0], period=0.01)
    return eqx.tree_at(lambda c: c.estimator, law, value, is_leaf=lambda x: x is None)


ERRORS = [
    ({"actuators": ()}, "controller has nothing to command: add an actuator that takes commands"),
    ({"controller": jb.Feedback([1.0, 2.0])}, "controller.gains must list one gain for each of 1"),
    ({"sensors": ()}, "controller.gains has 1 entry, but there are only 0 sensors"),
    (
        {"controller": jb.Feedback([1.0], higher_gains=[[1.0, 2.0]])},
        "controller.higher_gains must have in each row a gain for each of 1 actuators, not 2",
    ),
    (
        {"controller": jb.Feedback([1.0], higher_gains=[1.0])},
        "controller.higher_gains must be a list of lists of numbers",
    ),
    (
        {"controller": jb.Feedback([1.0], period=0.5), "sensors": (jb.Sensor(0.3),)},
        "controller.period must not exceed the run's duration, 0.3 s; it is 0.5 s",
    ),
    ({"controller": jb.Feedback([1.0], period=0.0)}, "controller.period must be positive"),
    ({"controller": jb.Feedback([1.0], power=0)}, "controller.power must be a whole number, 1 or"),
    (
        {"controller": jb.Feedback([1.0], period=2e-3, delay=-1e-3)},
        "controller.delay must not be negative; it is -0.001 s",
    ),
    ({"controller": jb.Feedback([1.0], delay=1e-3)}, f"controller.delay {SAMPLED}"),
    ({"controller": jb.Feedback([1.0], resolution=0.1)}, f"controller.resolution {SAMPLED}"),
    ({"controller": jb.Feedback([1.0])}, f"sensors.0.filter, which is digital, {SAMPLED}"),
    (
        {"controller": jb.Feedback([1.0]), "sensors": (jb.Sensor(0.3, delay=1e-3),)},
        f"sensors.0.delay {SAMPLED}",
    ),
    (
        {"controller": jb.Feedback([1.0]), "sensors": (jb.Sensor(0.3, noise=1e-5),)},
        f"sensors.0.noise {SAMPLED}",
    ),
    (
        {"controller": jb.Feedback([1.0]), "sensors": (jb.Sensor(0.3, "acceleration"),)},
        f"the acceleration of sensors.0 {SAMPLED}",
    ),
    (
        {
            "controller": jb.Feedback([1.0]),
            "sensors": (jb.Sensor(0.3),),
            "actuators": (jb.Patch(0.2, 0.3, 8e-4, rate_limit=3.0),),
        },
        f"the rate limit of actuators.0 {SAMPLED}",
    ),
    (
        {"controller": jb.Feedback([1.0], period=0.01)},
        "sensors.0.filter.cutoff must be below half the sampling frequency, 50 Hz; it is 60 Hz",
    ),
    (
        {
            "sensors": (
                jb.Sensor(0.3, "acceleration", filter=jb.Filter(9.0, realisation="analogue")),
            )
        },
        "sensors.0.filter cannot be analogue on an acceleration that a controller uses",
    ),
    (
        {"actuators": (dataclasses.replace(ACTUATOR, limits=jnp.array([1.0, -1.0])),)},
        "actuators.0.limits.1 must be above the entry before it; -1 V follows 1 V",
    ),
    (
        {"controller": jb.StateFeedback([[1.0, 2.0]])},
        "controller.gain must have a row for each actuator, a column for each state: (1, 5)",
    ),
    (
        {"controller": jb.Prescribed([1.0], amplitudes=[[1.0]])},
        "controller.amplitudes and frequencies belong together; give both or neither",
    ),
    (
        {"controller": jb.Prescribed([1.0], amplitudes=[[1.0]], frequencies=[1.0, 2.0])},
        "controller.amplitudes must have a column for each of the frequencies",
    ),
    (
        {"controller": jb.Prescribed([1.0], phases=[[1.0]])},
        "controller.phases have no effect without amplitudes and frequencies",
    ),
    (
        {"controller": jb.Prescribed([1.0], times=[0.0, 1.0], values=[[1.0, 2.0, 3.0]])},
        "controller.values must have a column for each of the times",
    ),
    (
        {"controller": jb.Prescribed([1.0], times=[0.0, 0.0], values=[[1.0, 2.0]])},
        "controller.times.1 must be above the entry before it; 0 s follows 0 s",
    ),
    (
        {"controller": jb.Prescribed([1.0, 2.0])},
        "controller.offsets must have an entry for each of 1 actuators",
    ),
    ({"controller": jb.Feedback([np.nan])}, "controller.gains.0 must be a finite number"),
    ({"controller": "feedback"}, "controller holds 'feedback'; it takes objects of type"),
    (
        {"controller": estimated_by("kalman")},
        "controller.estimator holds 'kalman'; it takes a table of its own, in Python a",
    ),
    (
        {"controller": estimated_by(jb.Kalman)},
        "it takes a table of its own, in Python a Inversion or Kalman or",
    ),
]


@pytest.mark.parametrize(("changes", "message"), ERRORS)
def test_errors_of_controllers(changes, message):
    if isinstance(changes.get("controller"), jb.Prescribed):
        changes = {"sensors": (), **changes}
    case = dataclasses.replace(HELD, **changes)
    for function in (check_case, jb.simulate):
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            function(case)
        assert "\n" not in str(caught.value)


def test_rows_of_gains_are_equally_long():
    with pytest.raises(
        ValueError, match="for each actuator: give numbers in rows that are equally"
    ):
        jb.OutputFeedback([[1.0, 2.0], [3.0]])


TABLES = [
    ({"kind": "feedbak", "gains": [1.0]}, "controller.kind cannot be 'feedbak'; did you mean"),
    ({"gains": [1.0]}, "controller.kind is missing; it may be feedback, "),
    ({"kind": "feedback", "gain": [1.0]}, "controller has no key 'gain'; did you mean 'gains'?"),
    ({"kind": "feedback"}, "controller.gains is missing; give the one gain for each actuator"),
    ({"kind": "feedback", "gains": 1.0}, "controller.gains must be a list of numbers, not 1.0"),
    (
        {"kind": "state", "gain": [[1.0, 2.0], [3.0]]},
        "controller.gain must be a list of lists of numbers, all equally long, not [[1.0, 2.0]",
    ),
    (
        {"kind": "feedback", "gains": [1.0], "period": "fast"},
        "controller.period must be one number, not 'fast'",
    ),
]


def test_too_long_period_is_refused():
    law = jb.Feedback([1.0], period=1e4)
    run = jb.Run(2e4, sample_rate=1e-4)
    case = dataclasses.replace(HELD, sensors=(jb.Sensor(0.3),), controller=law, run=run)
    with pytest.raises(RuntimeError, match="the interval of 10000 s between samples takes"):
        jb.simulate(case)


@pytest.mark.parametrize(("table", "message"), TABLES)
def test_errors_of_tables(table, message):
    content = case_to_dict(HELD) | {"controller": table}
    with pytest.raises(ValueError, match=re.escape(message)):
        case_from_dict(content)


def test_addresses_of_matrix_entries():
    law = jb.StateFeedback([[1.0, 2.0, 3.0, 4.0, 5.0]], period=1e-3)
    case = dataclasses.replace(HELD, controller=law)
    changed = jb.replace(case, {"controller.gain.0.3": 9.0})
    assert_array_equal(changed.controller.gain, [[1.0, 2.0, 3.0, 9.0, 5.0]])
    with pytest.raises(ValueError, match=r"no number at address 'controller.gain.0.5'"):
        jb.replace(case, {"controller.gain.0.5": 1.0})


def command_line(words: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words)
    return ended.value.code


def test_loop_on_the_command_line(tmp_path, capsys):
    path, output = tmp_path / "case.toml", tmp_path / "out.nc"
    jb.save_case(HELD, path)
    assert command_line(["simulate", str(path), "-o", str(output), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    record = jb.read_record(output)
    assert_allclose(printed["peak_deflection"], record.peak_deflection)
    assert_allclose(record.command, expected(HELD, record.times).command, rtol=0, atol=1e-8)
    assert command_line(["simulate", str(path)]) == 0
    table = capsys.readouterr().out
    assert "largest command" in table and "0.35" in table
    changed = ["--set", "controller.gains=[1,2]"]
    assert command_line(["simulate", str(path), *changed]) == 1
    assert "controller.gains must list one gain for each of 1" in capsys.readouterr().err


# Laws designed for a nominal plant and used on another one.

WEIGHTS = {"state_weight": [1e4, 1.0, 0.0], "command_weight": [1.0]}
SHAKER = jb.Shaker(0.3, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)


def beam_case(controller, rigidity=13.2, actuator=SHAKER):
    return jb.Case(
        jb.Beam(0.6, rigidity, 0.81, 0.03, modes=1),
        actuators=[actuator],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.3, speed=1.5)],
        controller=controller,
        run=jb.Run(0.2, sample_rate=100.0),
    )


def with_nominal(controller, case):
    return dataclasses.replace(controller, nominal_plant=jb.state_space(case))


def test_gain_is_that_for_the_nominal_plant():
    controller = jb.LQR(**WEIGHTS, period=0.01)
    case = beam_case(controller)
    other = beam_case(with_nominal(controller, case), rigidity=9.0)
    gain = controller.law(jb.state_space(case)).law.gain
    found = other.controller.law(jb.state_space(other)).law.gain
    assert_allclose(found, gain, rtol=1e-12)
    for_itself = controller.law(jb.state_space(other)).law.gain
    assert np.max(np.abs(found / for_itself - 1)) > 0.01
    fixed = beam_case(jb.StateFeedback(gain=np.asarray(gain), period=0.01), rigidity=9.0)
    commands = jb.simulate(other).command
    assert_allclose(commands, jb.simulate(fixed).command, rtol=1e-9, atol=1e-12)


def test_settings_are_validated_for_the_nominal_plant():
    """The design model names a parameter that only the shaker of the nominal plant has."""
    controller = jb.LQR(**WEIGHTS, design=DesignModel(force_per_volt=4.0))
    coil = jb.Electrodynamic(0.3, 3.0, 2e-3, 5.0, mass=0.02, stiffness=900.0, damping=1.0)
    with pytest.raises(ValueError, match=r"controller\.design\.force_per_volt has no effect"):
        check_case(beam_case(controller, actuator=coil))
    check_case(beam_case(with_nominal(controller, beam_case(controller)), actuator=coil))


def test_nominal_plant_is_no_key_of_case_files():
    controller = jb.LQR(**WEIGHTS)
    case = beam_case(with_nominal(controller, beam_case(controller)))
    with pytest.raises(ValueError, match="controller.nominal_plant is no key of a case file"):
        case_to_dict(case)


def test_derivatives_by_settings_of_the_design():
    """Forward mode through the design for the nominal plant, against a difference."""
    controller = jb.LQR(**WEIGHTS, period=0.01)
    nominal = beam_case(controller)

    def gain(weight):
        changed = jb.replace(nominal, {"controller.command_weight.0": weight})
        law = with_nominal(changed.controller, nominal).law(jb.state_space(nominal))
        return jnp.sum(law.law.gain)

    slope = jax.jacfwd(gain)(1.0)
    difference = (gain(1.001) - gain(0.999)) / 2e-3
    assert_allclose(slope, difference, rtol=1e-4)


class Silent(AbstractController):
    """A controller whose law has neither interface."""

    def design_law(self, plant):
        return None


@pytest.mark.parametrize(
    ("period", "message"),
    [(None, "AbstractContinuousLaw: give a period"), (0.01, "AbstractSampledLaw: leave")],
)
def test_laws_without_the_interface_are_refused(period, message):
    period = None if period is None else jnp.asarray(period)
    with pytest.raises(TypeError, match=f"the law of a Silent is a NoneType, no {message}"):
        jb.simulate(beam_case(Silent(period=period)))


OF_LOADS = "loads.0.mass", "run.gravity"
OF_PATHS = "loads.0.speed", "loads.0.entry_time"
# Those that have the loads in their model; all others share a design over masses.
WITH_LOADS = {
    *("feedback-scheduled", "feedback-scheduled-at-a-sample", "feedback-stepped"),
    *("kalman-known", "kalman-extended"),
    *("moving-horizon", "table", "family", "position", "position-followed", "nearest"),
    *("mpc-varying", "mpc-estimated"),
}


def numbers_of_law(case: jb.Case) -> list:
    """Numbers of the law that is designed for a case."""
    schedule = loop_schedule(case, np.asarray(sample_times(case)), float(case.run.duration))
    layout = mesh_layout(case)
    law = closed_loop(case, layout, load_set(case, layout), schedule).law
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(law, eqx.is_array_like))]


@pytest.mark.parametrize("kind", CASES)
def test_designs_depend_on_no_more_of_the_loads_than_they_declare(kind):
    case = CASES[kind]
    controller = case.controller
    assert controller.design_depends_on_loads == (kind in WITH_LOADS)
    free = [] if controller.design_depends_on_loads else list(OF_LOADS)
    free += [] if controller.design_depends_on_paths else list(OF_PATHS)
    before = numbers_of_law(case)
    for address in free:
        changed = 1.01 * value_at(case, address) + 1e-3
        after = numbers_of_law(jb.replace(case, {address: changed}))
        for one, other in zip(before, after, strict=True):
            np.testing.assert_array_equal(
                one, other, err_msg=f"{address} ({unit_at(case, address)})"
            )


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@pytest.mark.parametrize("kind", ["dlqr-kalman", "feedforward"])
def test_sweeps_of_loads_under_one_design_are_those_of_single_runs(kind, monkeypatch, tmp_path):
    """In C, where the loads of a path share a law."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(native_peaks, "MIN_RUNS_OF_LOOPS", 1)
    native_peaks.LIBRARY.build()
    case = dataclasses.replace(CASES[kind], sensors=CASES[kind].sensors[:1])
    over = {"loads.0.mass": [0.2, 0.6], "loads.0.speed": [2.0, 3.0]}
    found = jb.sweep(case, over, progress=False).peak_deflection.values
    for (i, mass), (j, speed) in itertools.product(*map(enumerate, over.values())):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass, "loads.0.speed": speed}))
        assert_allclose(found[i, j], record.peak_deflection, rtol=2e-6)
