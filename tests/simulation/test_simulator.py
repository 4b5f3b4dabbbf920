"""Runs inside of transformations: prepared once, or as they come; which plans are refused."""

import contextlib
import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import common_plan, integration_plan
from jaxbeam.simulation.integrator import step_size
from jaxbeam.simulation.integrator.step_size import ErrorFloor
from jaxbeam.simulation.simulate import simulate_histories, simulate_readings
from tests.differences import central

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=3),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    run=jb.Run(0.4, 100.0),
)
MASS, RIGIDITY = "loads.0.mass", "beam.flexural_rigidity"
SIMULATOR = jb.Simulator(CASE, {MASS: (0.1, 0.4)})


def peak_of(mass):
    return jb.simulate(jb.replace(CASE, {MASS: mass})).peak_deflection[0]


def test_a_simulator_gives_the_record_of_simulate():
    record, plain = SIMULATOR([0.2]), jb.simulate(jb.replace(CASE, {MASS: 0.2}))
    assert_allclose(record.deflection, plain.deflection, atol=1e-6 * plain.peak_deflection[0])
    assert record.result == 0
    assert SIMULATOR({MASS: 0.2}).peak_deflection == record.peak_deflection
    assert SIMULATOR(0.2).peak_deflection == record.peak_deflection


def test_stiffness_varies_on_a_foundation_whose_solutions_take_other_numbers_of_parts():
    """From 5 to 4 parts; the order of positions was said to differ."""
    beam = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=3, foundation_stiffness=3e4)
    case = jb.Case(beam, sensors=CASE.sensors, loads=CASE.loads, run=jb.Run(0.4, 400.0))

    def peak(rigidity):
        return jb.simulate(jb.replace(case, {RIGIDITY: rigidity})).peak_deflection[0]

    rigidities = np.array([9.0, 11.0, 18.0])
    simulator = jb.Simulator(case, {RIGIDITY: (9.0, 18.0)})
    found = [simulator([rigidity]).peak_deflection[0] for rigidity in rigidities]
    expected = [peak(rigidity) for rigidity in rigidities]
    assert_allclose(found, expected, rtol=1e-7)
    assert_allclose(jax.vmap(peak)(rigidities), expected, rtol=1e-7)


def test_masses_need_no_plan_under_jit_and_vmap():
    masses = np.array([0.1, 0.2, 0.3])
    expected = [peak_of(mass) for mass in masses]
    assert_allclose(jax.vmap(peak_of)(masses), expected, rtol=1e-7)
    assert_allclose(jax.jit(peak_of)(0.2), expected[1], rtol=1e-7)


def test_a_simulator_works_under_transformations():
    def misfit(mass):
        record = SIMULATOR([mass])
        return jnp.sum(record.deflection**2) / 1e-6 + record.peak_deflection[0] / 1e-3

    slope = central(lambda x: misfit(x[0]), [0.2], 1e-4)[0]
    assert_allclose(jax.grad(misfit)(0.2), slope, rtol=1e-6)
    assert_allclose(jax.jit(jax.grad(misfit))(0.2), slope, rtol=1e-6)
    assert_allclose(jax.jit(jax.vmap(misfit))(jnp.array([0.2]))[0], misfit(0.2), rtol=1e-9)
    total = jax.lax.scan(lambda sum_, m: (sum_ + misfit(m), None), 0.0, jnp.array([0.2, 0.3]))[0]
    assert_allclose(total, misfit(0.2) + misfit(0.3), rtol=1e-9)


@pytest.mark.parametrize("varied", [(MASS,), (MASS, RIGIDITY)], ids=["mass", "rigidity too"])
def test_second_derivatives_are_those_of_a_peak_that_moves(varied):
    simulator = jb.Simulator(CASE, varied)
    point = np.array([float(jb.addresses(CASE)[address]) for address in varied])

    def peak(values):
        return simulator(values * point).peak_deflection[0] / 1e-3

    found = jax.hessian(peak)(jnp.ones(len(varied)))
    assert_allclose(found, found.T, rtol=1e-8)
    assert_allclose(found, central(jax.grad(peak), np.ones(len(varied)), 1e-3), rtol=1e-5)


def test_a_simulator_may_be_an_argument_of_transformations():
    """Its numbers were traced, and `jax.jit` could not hash them."""
    expected = SIMULATOR([0.2]).peak_deflection
    assert_allclose(jax.jit(SIMULATOR)([0.2]).peak_deflection, expected, rtol=1e-12)
    peak = eqx.filter_jit(lambda simulator, mass: simulator([mass]).peak_deflection)
    assert_allclose(peak(SIMULATOR, 0.2), expected, rtol=1e-12)


@pytest.mark.parametrize("prepared", [True, False])
def test_a_vmap_within_a_vmap_gives_the_runs_of_all_pairs(prepared):
    """The outer number was converted to NumPy."""
    simulator = jb.Simulator(CASE, {MASS: (0.1, 0.4), "loads.0.speed": (1.0, 3.0)})

    def peak(mass, speed):
        values = {MASS: mass, "loads.0.speed": speed}
        record = simulator(values) if prepared else jb.simulate(jb.replace(CASE, values))
        return record.peak_deflection[0]

    masses, speeds = np.array([0.1, 0.3]), np.array([1.0, 2.0, 3.0])
    found = jax.vmap(lambda m: jax.vmap(lambda v: peak(m, v))(speeds))(masses)
    expected = [[peak(m, v) for v in speeds] for m in masses]
    assert_allclose(found, expected, rtol=1e-6)


def test_a_run_under_jit_says_what_is_wrong_with_it():
    result = jax.jit(lambda mass: SIMULATOR([mass]).result)
    assert jb.Result(int(result(0.2))) == jb.Result(0)
    assert jb.Result(int(result(0.5))) == jb.Result.OUT_OF_RANGE
    with pytest.raises(ValueError, match="out of the range for which the steps were chosen"):
        SIMULATOR([0.5])


def test_a_run_that_is_not_finite_has_no_peaks_in_a_batch():
    """Its peak was 0 and its lowest contact force infinite: XLA's maxima pass over NaN."""

    def numbers(mass):
        record = SIMULATOR([mass])
        return record.peak_deflection[0], record.lowest_contact_force[0], record.result

    peaks, forces, results = jax.jit(jax.vmap(numbers))(np.array([0.2, np.nan]))
    assert_allclose(peaks, [peak_of(0.2), np.nan], rtol=1e-6)
    assert np.array_equal(np.isnan(forces), [False, True])
    assert jb.Result.DIVERGED in jb.Result(int(results[1]))


def test_ends_of_a_range_that_diverge_take_no_error_estimate_from_other_runs():
    """All runs had NaN, and a result of 0, as the loop of the middle of the range diverges."""
    law = jb.Feedback([900.0], period=0.005)
    case = dataclasses.replace(CASE, actuators=(jb.PointForce(0.3),), controller=law)
    record = jb.Simulator(case, {"controller.gains.0": (100.0, 2e6)})([900.0])
    exact = jb.simulate(case, tolerance=1e-10).peak_deflection
    error = np.max(np.abs(record.peak_deflection / exact - 1))
    assert error <= record.error_estimate < 1e-6 and record.result == 0
    record = jb.Simulator(case, {"controller.gains.0": (1e6, 2e6)})([1e6])
    assert record.result == jb.Result.DIVERGED and np.isnan(record.error_estimate)


def test_single_precision_is_refused():
    """The record said 2e-8 where peaks were 1.5e-6 off."""
    with jax.enable_x64(False):
        for function in (peak_of, lambda mass: SIMULATOR([mass]).peak_deflection[0]):
            for transformed in (jax.jit(function), jax.grad(function)):
                with pytest.raises(ValueError, match=r"single precision.*jax_enable_x64"):
                    transformed(0.2)
        assert_allclose(peak_of(0.2), SIMULATOR(0.2).peak_deflection[0], rtol=1e-6)


WRONG = {
    "unknown rigidity": (
        lambda x: jb.simulate(jb.replace(CASE, {RIGIDITY: x})),
        r"beam.flexural_rigidity is traced by jax.jit.*jb.Simulator\(case, vary=",
    ),
    "traced times": (lambda x: jb.simulate(CASE, jnp.arange(3) * x), "times, or run.duration"),
    "traced duration": (
        lambda x: jb.simulate(jb.replace(CASE, {"run.duration": x})),
        "times, or run.duration",
    ),
    "a simulator within": (
        lambda x: jb.Simulator(jb.replace(CASE, {RIGIDITY: x})),
        "make it outside of",
    ),
    "modes without a layout": (
        lambda x: jb.modes(jb.replace(CASE, {"beam.length": x})).stiffness,
        "beam.length is traced by jax.jit.* order of supports",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_must_be_known_is_said_in_one_sentence(name):
    function, message = WRONG[name]
    with pytest.raises((ValueError, TypeError), match=message) as raised:
        jax.jit(lambda x: jax.tree.leaves(function(x))[0])(1.0)
    assert len(str(raised.value).split("\n")) == 1


def test_wrong_uses_of_a_simulator_are_said():
    with pytest.raises(ValueError, match="does not vary"):
        SIMULATOR({"loads.0.speed": 1.0})
    with pytest.raises(ValueError, match=r"must be \(low, high\)"):
        jb.Simulator(CASE, {MASS: (2.0, 1.0)})
    with pytest.raises(ValueError, match=r"must be \(low, high\), not 0.3"):
        jb.Simulator(CASE, {MASS: 0.3})
    for vary in (None, [3]):
        with pytest.raises(ValueError, match=r"vary lists addresses, such as .*, not \[?(None|3)"):
            jb.Simulator(CASE, vary)
    with pytest.raises(ValueError, match=r"as many values as numbers vary, 1 .*, not 2"):
        SIMULATOR([0.2, 0.3])
    with pytest.raises(ValueError, match="fixes the number of samples"):
        jb.Simulator(CASE, ("run.duration",))


@pytest.mark.parametrize(
    ("address", "most"), [(MASS, 900), (RIGIDITY, 1400), ("loads.0.speed", 2200)]
)
def test_programs_hold_only_what_varies(address, most):
    """Equations of whole records; all stages of a run are 4000."""
    simulator = jb.Simulator(CASE, (address,))
    value = float(jb.addresses(CASE)[address])
    program = jax.make_jaxpr(lambda x: jax.tree.leaves(simulator([x])))(value)
    assert equations(program.jaxpr) < most


def equations(jaxpr) -> int:
    """Number of equations of a program, with those of its loops and branches."""
    parameters = [list(equation.params.values()) for equation in jaxpr.eqns]
    inner = jax.tree.leaves(parameters, is_leaf=lambda part: hasattr(part, "eqns"))
    programs = (getattr(part, "jaxpr", part) for part in inner)
    return len(jaxpr.eqns) + sum(equations(part) for part in programs if hasattr(part, "eqns"))


# Plans of other cases or times are refused, and so are tolerances that cannot be reached.

FORCE = jb.MovingForce(force=5.0, speed=2.0)
BEAM = jb.Beam(0.6, 11.68, 0.535, modes=4)
SPAN = jb.Case(BEAM, sensors=[jb.Sensor(0.3)], loads=[FORCE], run=jb.Run(0.4, sample_rate=200.0))
LOOP = dataclasses.replace(
    SPAN,
    actuators=(jb.PointForce(0.15),),
    controller=jb.Prescribed(offsets=[0.5], period=0.02),
)
LATER = dataclasses.replace(FORCE, entry_time=0.3)
TWO = dataclasses.replace(SPAN, loads=(FORCE, LATER))

# What differs from the case of the plan, and the word of the sentence that says so.
OTHERS = {
    "two forces": (SPAN, dataclasses.replace(SPAN, loads=(FORCE, LATER)), "other loads"),
    "another kind": (
        SPAN,
        dataclasses.replace(SPAN, loads=(jb.MovingMass(mass=0.5, speed=2.0),)),
        "other loads",
    ),
    "modes": (
        SPAN,
        dataclasses.replace(SPAN, beam=dataclasses.replace(BEAM, modes=9)),
        "beam",
    ),
    "support": (SPAN, dataclasses.replace(SPAN, supports=(jb.Support(0.2),)), "supports"),
    "support elsewhere": (
        dataclasses.replace(SPAN, supports=(jb.Support(0.2), jb.Support(0.4, stiffness=1e3))),
        dataclasses.replace(SPAN, supports=(jb.Support(0.5), jb.Support(0.4, stiffness=1e3))),
        "another order",
    ),
    "no loop": (LOOP, dataclasses.replace(LOOP, controller=None), "controller"),
    "period": (LOOP, jb.replace(LOOP, {"controller.period": 0.03}), "other times"),
    "delay": (
        LOOP,
        dataclasses.replace(LOOP, controller=dataclasses.replace(LOOP.controller, delay=0.01)),
        "other times",
    ),
    "stiffer": (SPAN, jb.replace(SPAN, {"beam.flexural_rigidity": 1e6}), "too long"),
    "faster": (SPAN, jb.replace(SPAN, {"loads.0.speed": 40.0}), "too long"),
    "together": (TWO, jb.replace(TWO, {"loads.1.entry_time": 0.05}), "at most 1 load"),
    "duration": (SPAN, jb.replace(SPAN, {"run.duration": 0.3}), "61 samples from 0 to 0.3 s"),
    "sample rate": (SPAN, jb.replace(SPAN, {"run.sample_rate": 100.0}), "41 samples"),
}


@pytest.mark.parametrize(("planned", "case", "word"), OTHERS.values(), ids=OTHERS)
def test_a_plan_of_another_case_is_refused(planned, case, word):
    with pytest.raises(ValueError, match=word):
        jb.simulate(case, plan=integration_plan(planned))


TIMES = np.linspace(0.0, 0.35, 8)


@pytest.mark.parametrize("case", [SPAN, LOOP], ids=["free", "loop"])
@pytest.mark.parametrize(
    "use",
    [
        lambda case, plan: jb.simulate(case, plan=plan),
        lambda case, plan: jb.simulate(case, TIMES * 1.01, plan),
        lambda case, plan: simulate_readings(case, TIMES[:-1], plan),
        lambda case, plan: simulate_histories(case, TIMES + 0.001, plan, np.array([0.3])),
    ],
)
def test_a_plan_for_other_times_is_refused(case, use):
    plan = integration_plan(case, TIMES)
    with pytest.raises(ValueError, match="the plan was made for 8 samples from 0 to 0.35 s"):
        use(case, plan)


def test_traced_runs_compare_what_is_known():
    plan = integration_plan(SPAN)

    def peak(force, case):
        return jb.simulate(jb.replace(case, {"loads.0.force": force}), plan=plan).peak_deflection[0]

    assert np.isclose(jax.jit(lambda f: peak(f, SPAN))(10.0), 2 * peak(5.0, SPAN), rtol=1e-9)
    with pytest.raises(ValueError, match="other loads"):
        jax.jit(lambda f: peak(f, TWO))(10.0)
    with pytest.raises(ValueError, match="made for 81 samples"):
        jax.jit(lambda f: peak(f, jb.replace(SPAN, {"run.duration": 0.3})))(10.0)


def test_the_error_of_other_numbers_is_not_stated():
    plan = integration_plan(SPAN)
    other = jb.replace(SPAN, {"beam.flexural_rigidity": 12.0})
    record, exact = jb.simulate(other, plan=plan), jb.simulate(other)
    assert np.isnan(record.error_estimate) and np.isnan(record.step_errors).all()
    assert "unknown" in record.verdict
    assert np.allclose(record.peak_deflection, exact.peak_deflection, rtol=1e-6)
    both = common_plan([plan, integration_plan(other)])
    assert all(np.isfinite(jb.simulate(own, plan=both).error_estimate) for own in (SPAN, other))
    with pytest.raises(ValueError, match="other loads"):
        jb.simulate(TWO, plan=both)


def test_plan_and_tolerance_contradict():
    plan = integration_plan(SPAN, None, 1e-3)
    plan = dataclasses.replace(plan, error=1e-4)
    with pytest.raises(ValueError, match="give one of them only"):
        jb.simulate(SPAN, plan=plan, tolerance=1e-9)


@pytest.mark.parametrize("first", [-0.1, np.nan])
def test_times_before_the_start_are_refused(first):
    times = np.array([first, 0.1, 0.2])
    with pytest.raises(ValueError, match="start of the run"):
        jb.simulate(SPAN, times)
    with pytest.raises(ValueError, match="start of the run"):
        integration_plan(SPAN, times)


RIG = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=1),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.2, speed=2.0)],
    run=jb.Run(duration=0.1, sample_rate=100.0),
)


def test_a_tolerance_below_rounding_names_one_that_is_met(monkeypatch):
    lengths, run_of_grid = [], step_size.run_of_grid

    def counted(grid, *arguments):
        lengths.append(np.max(grid.lengths))
        return run_of_grid(grid, *arguments)

    monkeypatch.setattr(step_size, "run_of_grid", counted)
    with pytest.raises(RuntimeError, match="in double precision it agrees to") as raised:
        jb.simulate(RIG, tolerance=1e-14)
    assert len(lengths) < 60
    assert min(lengths) > 1e-6  # the search had gone on to hundred million steps
    advised = float(re.search(r"a tolerance of (\S+) or more", str(raised.value))[1])
    assert 1e-14 < advised < 1e-11
    assert jb.simulate(RIG, tolerance=advised).error_estimate <= advised


def test_a_controlled_run_names_one_too():
    controlled = jb.Case(
        RIG.beam,
        sensors=RIG.sensors,
        loads=RIG.loads,
        actuators=[jb.PointForce(0.2)],
        controller=jb.Feedback(gains=[300.0], period=0.01),
        run=RIG.run,
    )
    with pytest.raises(RuntimeError, match="in double precision it agrees to"):
        jb.simulate(controlled, tolerance=1e-14)


def test_an_error_is_rounding_where_a_sixteenth_of_the_step_has_not_halved_it():
    for halved, error in ((False, 0.5e-11), (True, 0.49e-11)):
        floor = ErrorFloor(1e-13)
        floor.check(1e-11, 1.0)
        floor.check(0.9e-11, 1 / 15.9)  # the next step may still lessen it
        refused = pytest.raises(RuntimeError, match="agrees to 1.0e-11; give a tolerance of 4e-11")
        with contextlib.nullcontext() if halved else refused:
            floor.check(error, 1 / 16)


def test_an_error_too_large_to_be_rounding_ends_no_search():
    floor = ErrorFloor(1e-13)
    for step in (1.0, 1e-3):
        floor.check(2e-9, step)


def deflection_under_a_limited_spring(gain: float, limit: float) -> float:
    """Deflection (m) at midspan at the end of the run, by a solver that knows nothing of jaxbeam.

    One mode q of the pinned beam, w = phi(x) q with phi = sqrt(2 / (m L)) sin(pi x / L), under a
    moving mass and the force -gain w(L/2) at x = 0.2 m within limits.
    """
    length, rigidity, line_mass, mass, speed = 0.6, 11.68, 0.535, 0.2, 2.0
    wave = np.pi / length
    size = np.sqrt(2 / (line_mass * length))
    at_force, at_middle = size * np.sin(wave * 0.2), size

    def rates(t, state):
        q, rate = state
        x = wave * speed * t
        phi, slope = size * np.sin(x), size * wave * speed * np.cos(x)
        force = np.clip(-gain * at_middle * q, -limit, limit)
        load = -mass * (9.81 + 2 * slope * rate - (wave * speed) ** 2 * phi * q) * phi
        own = -(wave**4) * rigidity / line_mass * q
        return rate, (own + at_force * force + load) / (1 + mass * phi**2)

    found = scipy.integrate.solve_ivp(
        rates, (0.0, 0.1), (0.0, 0.0), "DOP853", max_step=1e-4, rtol=1e-12, atol=1e-18
    )
    return at_middle * found.y[0, -1]


def test_a_continuous_law_that_saturates_names_the_tolerance_that_is_met():
    """Its commands bend within steps, so that halved steps lessen the error slowly."""
    limited = jb.Case(
        RIG.beam,
        sensors=RIG.sensors,
        loads=RIG.loads,
        actuators=[jb.PointForce(0.2, limits=(-0.5, 0.5))],
        controller=jb.Feedback(gains=[3000.0]),
        run=RIG.run,
    )
    with pytest.raises(RuntimeError, match="as forces bend or jump within it") as raised:
        jb.simulate(limited, tolerance=1e-12)
    met = float(re.search(r"the shortest one to (\S+), as", str(raised.value))[1])
    assert 1e-12 < met < 1e-7
    record = jb.simulate(limited, tolerance=1.1 * met)
    assert np.ptp(np.abs(record.command)) == 0.5  # it saturates
    expected = deflection_under_a_limited_spring(3000.0, 0.5)
    assert abs(record.sensor_values[-1, 0] - expected) < 1e-7 * abs(record.peak_deflection[0])


@pytest.mark.parametrize("tolerance", [0.0, -1e-7, 1e-15, 1.0, np.nan, np.inf])
def test_tolerances_that_are_no_share_are_refused_before_any_work(tolerance):
    invalid = jb.Case(RIG.beam)  # has no loads: not looked at
    with pytest.raises(ValueError, match="tolerance must be at least 1e-14 and below 1"):
        jb.simulate(invalid, tolerance=tolerance)
    with pytest.raises(ValueError, match="tolerance must be at least 1e-14 and below 1"):
        jb.sweep(RIG, {"loads.0.mass": [0.1]}, tolerance=tolerance, progress=False)
