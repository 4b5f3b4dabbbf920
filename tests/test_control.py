"""Controllers in cases, records, batches and derivatives; and how faulty ones are refused."""

import dataclasses
import json
import logging
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.casefile import case_from_dict, case_to_dict
from jaxbeam.checks import check
from jaxbeam.cli import main
from jaxbeam.loop import loop_schedule
from jaxbeam.plan import Plan, form
from tests.differences import central
from tests.loop_as_oracle import expected

BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2)
MASS = jb.MovingMass(mass=0.4, speed=2.5)
TIMES = jnp.linspace(0.0, 0.3, 31)
HELD = jb.Case(
    BEAM,
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0, limits=[-0.3, 0.35])],
    sensors=[jb.Sensor(0.25, filter=jb.Filter(60.0, 3))],
    loads=[MASS],
    controller=jb.Feedback([600.0], period=2e-3, delay=5e-4),
    run=jb.Run(0.3, sample_rate=100.0),
    title="a loop",
)


def planned(case: jb.Case, times=TIMES, substeps: int = 1) -> Plan:
    return Plan(form(case), substeps, 0, False, 0.0, loop_schedule(case, np.asarray(times)))


@pytest.fixture(scope="module")
def plan():
    return planned(HELD)


@pytest.fixture(scope="module")
def record(plan):
    return jb.simulate(HELD, TIMES, plan)


def test_the_record_tells_command_saturation_and_effort(record):
    truth = expected(HELD, TIMES).command
    assert_allclose(record.command, truth, rtol=0, atol=1e-10)
    assert_array_equal(record.saturated, truth == 0.35)
    assert 0 < np.sum(record.saturated) < TIMES.size
    assert_allclose(record.effort, np.trapezoid(truth**2, TIMES, axis=0), rtol=1e-9)
    assert np.isnan(record.diverged_time)
    assert record.verdict.startswith("every load presses on the beam throughout")


def test_a_record_with_a_controller_survives_its_file(record, tmp_path):
    record.to_netcdf(tmp_path / "loop.nc")
    back = jb.read_record(tmp_path / "loop.nc")
    assert jax.tree.structure(back) == jax.tree.structure(record)
    jax.tree.map(assert_array_equal, back, record)
    dataset = record.to_xarray()
    assert dataset.command.dims == ("time", "actuator")
    assert json.loads(dataset.attrs["case"])["controller"]["gains"] == [600.0]


# Divergence

UNBOUNDED = dataclasses.replace(HELD, actuators=(jb.PointForce(0.3),), sensors=(jb.Sensor(0.25),))
GAINS, MASSES = np.array([100.0, 1e5, 700.0]), np.array([0.1, 0.4])


def test_a_loop_with_too_high_a_gain_ends_with_a_verdict():
    """Warnings are errors here: it warns of nothing, and it does not fail."""
    record = jb.simulate(jb.replace(UNBOUNDED, {"controller.gains.0": 1e5}))
    gone = float(record.diverged_time)
    assert 0 < gone < 0.3
    assert (
        f"the control loop diverges: the deflection has grown beyond all bounds by t = {gone:.4g}"
        in record.verdict
    )
    before = np.asarray(record.times) < gone
    assert np.all(np.isfinite(record.deflection[before]))
    assert np.all(np.abs(record.deflection[before]) < 0.6)
    assert np.all(np.isnan(record.deflection[~before]))
    assert np.isnan(record.peak_deflection).all() and np.isnan(record.error_estimate)


@pytest.fixture(scope="module")
def swept():
    """A sweep over gains, one of which diverges, and masses; and what was compiled for it."""
    found = []

    class Names(logging.Handler):
        def emit(self, record):
            found.append(record.getMessage())

    logger, handler = logging.getLogger("jax"), Names()
    logger.addHandler(handler)
    jax.config.update("jax_log_compiles", True)  # in all threads, as its context is not
    try:
        over = {"controller.gains.0": GAINS, "loads.0.mass": MASSES}
        dataset = jb.sweep(UNBOUNDED, over, progress=False)
    finally:
        jax.config.update("jax_log_compiles", False)
        logger.removeHandler(handler)
    return dataset, [message for message in found if "Compiling jit(_block)" in message]


@pytest.mark.slow
def test_only_the_diverging_members_of_a_sweep_fail(swept):
    dataset, compiled = swept
    assert_array_equal(dataset.failed, [[False, False], [True, True], [False, False]])
    assert np.isnan(dataset.peak_deflection[1]).all()
    assert len(compiled) == 1
    plan = planned(UNBOUNDED)
    for i in (0, 2):
        for j in range(2):
            values = {"controller.gains.0": GAINS[i], "loads.0.mass": MASSES[j]}
            one = jb.simulate(jb.replace(UNBOUNDED, values), TIMES, plan)
            assert_allclose(dataset.peak_deflection[i, j], one.peak_deflection, rtol=1e-7)


@pytest.mark.slow
def test_a_batch_of_gains_is_what_each_gives_alone():
    plan = planned(UNBOUNDED)

    def deflection(gain):
        case = jb.replace(UNBOUNDED, {"controller.gains.0": gain})
        return jb.simulate(case, TIMES, plan).deflection

    together = jax.jit(jax.vmap(deflection))(jnp.asarray(GAINS))
    for gain, found in zip(GAINS, together, strict=True):
        # Rounding grows where the loop diverges.
        assert_allclose(found, deflection(gain), rtol=1e-12 if gain < 1e4 else 1e-6, atol=1e-15)
    assert np.isnan(together[1]).any() and np.isfinite(together[np.array([0, 2])]).all()


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


@pytest.mark.slow
def test_gradients_through_filter_hold_delay_and_saturation(plan, record):
    sizes = np.array(list(FREE.values()))
    data = record.deflection + 2e-4 * jnp.cos(jnp.arange(31.0))[:, None]

    @jax.jit
    def outputs(point):
        case = jb.replace(HELD, dict(zip(FREE, point * sizes, strict=True)))
        found = jb.simulate(case, TIMES, plan)
        misfit = jnp.sum(((found.deflection - data) / 1e-3) ** 2)
        return jnp.stack([misfit, found.peak_deflection[0] * 1e3, found.effort[0]])

    at = jnp.ones(len(FREE))
    differences = central(outputs, at, step=2e-4, order=4)
    size = np.max(np.abs(differences), axis=1, keepdims=True)
    assert np.all(np.abs(differences[0]) > 1e-4 * size[0])
    for derivative in (jax.jacfwd, jax.jacrev):
        found = derivative(outputs)(at)
        assert_allclose(found / size, differences / size, rtol=1e-6, atol=1e-8)


LAW = dataclasses.replace(
    HELD,
    actuators=(jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0),),
    sensors=(jb.Sensor(0.25, filter=jb.Filter(30.0, 3, realisation="analogue")),),
    controller=jb.Feedback([3e8], power=3),
)


@pytest.mark.slow
def test_gradients_of_a_law_at_every_instant():
    names = ("controller.gains.0", "sensors.0.filter.cutoff", "actuators.0.damping", "loads.0.mass")
    sizes = np.array([float(jb.addresses(LAW)[name]) for name in names])
    plan = planned(LAW, substeps=2)

    @jax.jit
    def outputs(point):
        case = jb.replace(LAW, dict(zip(names, point * sizes, strict=True)))
        found = jb.simulate(case, TIMES, plan)
        return jnp.stack([jnp.sum((found.deflection * 1e3) ** 2), found.effort[0]])

    at = jnp.ones(len(names))
    differences = central(outputs, at, step=2e-3, order=6)
    assert_allclose(jax.jacrev(outputs)(at), differences, rtol=1e-6)


# Bad input

ACTUATOR, LISTENER = HELD.actuators[0], HELD.sensors[0]
SAMPLED = "needs a controller that samples: give controller.period"
FAULTS = [
    ({"actuators": ()}, "controller has nothing to command: add an actuator, or leave it out"),
    ({"controller": jb.Feedback([1.0, 2.0])}, "controller.gains must list one gain for each of 1"),
    ({"sensors": ()}, "controller.gains has 1 entries, but there are only 0 sensors"),
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
        "sensors.0.filter cannot be analogue on an acceleration that a controller looks at",
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
]


@pytest.mark.parametrize(("changes", "message"), FAULTS)
def test_faulty_loops_are_refused(changes, message):
    if isinstance(changes.get("controller"), jb.Prescribed):
        changes = {"sensors": (), **changes}
    case = dataclasses.replace(HELD, **changes)
    for look in (check, jb.simulate):
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            look(case)
        assert "\n" not in str(caught.value)


TABLES = [
    ({"kind": "feedbak", "gains": [1.0]}, "controller.kind cannot be 'feedbak'; did you mean"),
    ({"gains": [1.0]}, "controller.kind is missing; it may be dlqr, "),
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


@pytest.mark.parametrize(("table", "message"), TABLES)
def test_faulty_tables_are_refused(table, message):
    content = case_to_dict(HELD) | {"controller": table}
    with pytest.raises(ValueError, match=re.escape(message)):
        case_from_dict(content)


CONTROLLERS = [
    HELD.controller,
    jb.Feedback([1.0], 3, resolution=0.1, period=0.01),
    jb.Feedback([1.0], higher_gains=[[2.0], [3.0]], period=0.01),
    jb.StateFeedback([[1.0, 2.0, 3.0, 4.0, 5.0]], period=1e-3, delay=2e-3),
    jb.Prescribed(
        [0.1],
        amplitudes=[[1.0, 2.0]],
        frequencies=[3.0, 4.0],
        phases=[[0.0, 1.0]],
        times=[0.0, 1.0, 1.5],
        values=[[1.0, -1.0, 0.5]],
    ),
]


@pytest.mark.parametrize("controller", CONTROLLERS, ids=lambda c: type(c).__name__)
def test_a_case_file_keeps_the_controller(controller, tmp_path):
    sensor = jb.Sensor(0.25)
    case = dataclasses.replace(HELD, controller=controller, sensors=(sensor,))
    jb.save_case(case, tmp_path / "case.toml")
    assert eqx.tree_equal(jb.load_case(tmp_path / "case.toml"), case)


def test_entries_of_matrices_have_addresses():
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


def test_the_command_line_runs_a_loop(tmp_path, capsys):
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
