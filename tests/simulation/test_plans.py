"""Plans of other cases or times are refused, and so are tolerances that cannot be reached."""

import dataclasses
import re

import jax
import numpy as np
import pytest
import scipy

import jaxbeam as jb
from jaxbeam.integrator import step_size
from jaxbeam.simulation.integration_plan import common_plan, integration_plan
from jaxbeam.simulation.simulate import simulate_histories, simulate_readings

FORCE = jb.MovingForce(force=5.0, speed=2.0)
BEAM = jb.Beam(0.6, 11.68, 0.535, modes=4)
CASE = jb.Case(BEAM, sensors=[jb.Sensor(0.3)], loads=[FORCE], run=jb.Run(0.4, sample_rate=200.0))
LOOP = dataclasses.replace(
    CASE,
    actuators=(jb.PointForce(0.15),),
    controller=jb.Prescribed(offsets=[0.5], period=0.02),
)
LATER = dataclasses.replace(FORCE, entry_time=0.3)
TWO = dataclasses.replace(CASE, loads=(FORCE, LATER))

# What differs from the case of the plan, and the word of the sentence that says so.
OTHERS = {
    "two forces": (CASE, dataclasses.replace(CASE, loads=(FORCE, LATER)), "other loads"),
    "another kind": (
        CASE,
        dataclasses.replace(CASE, loads=(jb.MovingMass(mass=0.5, speed=2.0),)),
        "other loads",
    ),
    "modes": (CASE, dataclasses.replace(CASE, beam=dataclasses.replace(BEAM, modes=9)), "beam"),
    "support": (CASE, dataclasses.replace(CASE, supports=(jb.Support(0.2),)), "supports"),
    "support elsewhere": (
        dataclasses.replace(CASE, supports=(jb.Support(0.2), jb.Support(0.4, stiffness=1e3))),
        dataclasses.replace(CASE, supports=(jb.Support(0.5), jb.Support(0.4, stiffness=1e3))),
        "another order",
    ),
    "no loop": (LOOP, dataclasses.replace(LOOP, controller=None), "controller"),
    "period": (LOOP, jb.replace(LOOP, {"controller.period": 0.03}), "other times"),
    "delay": (
        LOOP,
        dataclasses.replace(LOOP, controller=dataclasses.replace(LOOP.controller, delay=0.01)),
        "other times",
    ),
    "stiffer": (CASE, jb.replace(CASE, {"beam.flexural_rigidity": 1e6}), "too long"),
    "faster": (CASE, jb.replace(CASE, {"loads.0.speed": 40.0}), "too long"),
    "together": (TWO, jb.replace(TWO, {"loads.1.entry_time": 0.05}), "at most 1 loads"),
    "duration": (CASE, jb.replace(CASE, {"run.duration": 0.3}), "61 samples from 0 to 0.3 s"),
    "sample rate": (CASE, jb.replace(CASE, {"run.sample_rate": 100.0}), "41 samples"),
}


@pytest.mark.parametrize(("planned", "case", "word"), OTHERS.values(), ids=OTHERS)
def test_a_plan_of_another_case_is_refused(planned, case, word):
    with pytest.raises(ValueError, match=word):
        jb.simulate(case, plan=integration_plan(planned))


TIMES = np.linspace(0.0, 0.35, 8)


@pytest.mark.parametrize("case", [CASE, LOOP], ids=["free", "loop"])
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
    plan = integration_plan(CASE)

    def peak(force, case):
        return jb.simulate(jb.replace(case, {"loads.0.force": force}), plan=plan).peak_deflection[0]

    assert np.isclose(jax.jit(lambda f: peak(f, CASE))(10.0), 2 * peak(5.0, CASE), rtol=1e-9)
    with pytest.raises(ValueError, match="other loads"):
        jax.jit(lambda f: peak(f, TWO))(10.0)
    with pytest.raises(ValueError, match="made for 81 samples"):
        jax.jit(lambda f: peak(f, jb.replace(CASE, {"run.duration": 0.3})))(10.0)


def test_the_error_of_other_numbers_is_not_stated():
    plan = integration_plan(CASE)
    other = jb.replace(CASE, {"beam.flexural_rigidity": 12.0})
    record, exact = jb.simulate(other, plan=plan), jb.simulate(other)
    assert np.isnan(record.error_estimate) and np.isnan(record.step_errors).all()
    assert "unknown" in record.verdict
    assert np.allclose(record.peak_deflection, exact.peak_deflection, rtol=1e-6)
    both = common_plan([plan, integration_plan(other)])
    assert all(np.isfinite(jb.simulate(own, plan=both).error_estimate) for own in (CASE, other))
    with pytest.raises(ValueError, match="other loads"):
        jb.simulate(TWO, plan=both)


def test_plan_and_tolerance_contradict():
    plan = integration_plan(CASE, None, 1e-3)
    plan = dataclasses.replace(plan, error=1e-4)
    with pytest.raises(ValueError, match="give one of them only"):
        jb.simulate(CASE, plan=plan, tolerance=1e-9)


@pytest.mark.parametrize("first", [-0.1, np.nan])
def test_times_before_the_start_are_refused(first):
    times = np.array([first, 0.1, 0.2])
    with pytest.raises(ValueError, match="start of the run"):
        jb.simulate(CASE, times)
    with pytest.raises(ValueError, match="start of the run"):
        integration_plan(CASE, times)


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
