"""Every physics function gives the same from known numbers, in NumPy, as traced by `jax.jit`.

Both come from the same lines (see `jaxbeam.runtime.arrays`); here they are called both ways, with
the same numbers. What compiles nothing is counted in a process of its own.
"""

import dataclasses
import os
import subprocess
import sys

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import run_peaks
from jaxbeam.analysis.stability import frozen_poles, growth, stream
from jaxbeam.case.controller import Measurement
from jaxbeam.case.sensors import QUANTITIES, Filter
from jaxbeam.model.contact import contact_at
from jaxbeam.model.deflection_lines import static_deflection_per_command
from jaxbeam.model.flexibility import flexibility
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.output_rows import sensor_rows
from jaxbeam.runtime.arrays import any_jax, xp
from jaxbeam.runtime.compiling import LOW_OPTIMISATION, xla_options
from jaxbeam.simulation.integration_plan import integration_plan, sample_times
from jaxbeam.simulation.integrator.discrete_model import discrete_model, propagators
from jaxbeam.simulation.integrator.integrate import max_stable_step
from jaxbeam.simulation.integrator.step_size import static_shapes
from jaxbeam.simulation.integrator.time_grid import grid_by_step_length

TOLERANCE = 1e-11  # relative to the largest entry of each array
# Where a curve is flat, its values differ by the square of a difference in time.
CANCELLED, CANCELLED_TOLERANCE = ("peak_time", "smallest_time", "largest_time"), 1e-7

BEAM = jb.Beam(
    length=1.2,
    flexural_rigidity=11.68,
    mass_per_length=0.535,
    damping_ratio=[0.03, 0.02, 0.02, 0.01],
    ends="clamped-pinned",
    modes=4,
)
SENSORS = tuple(
    jb.Sensor(
        0.17 + 0.1 * i,
        quantity,
        fibre_distance=1e-3 if entry.at_fibre else None,
        section_modulus=1e-6 if entry.over_modulus else None,
    )
    for i, (quantity, entry) in enumerate(QUANTITIES.items())
    if not entry.of_twist
)
TABLE = {"times": [0.0, 0.05, 0.2, 0.3], "positions": [0.9, 0.6, 0.7, 0.2]}
RUN = jb.Run(duration=0.25, sample_rate=200.0)
MASSES = jb.Case(
    BEAM,
    supports=[jb.Support(0.5), jb.Support(1.2, rotational_stiffness=3.0)],
    sensors=SENSORS,
    loads=[
        jb.MovingMass(mass=0.1, speed=6.0),
        jb.MovingMass(mass=0.05, speed=-5.0, entry_time=0.05, deceleration=8.0),
        jb.MovingForce(force=3.0, speed=9.0, entry_time=0.02),
    ],
    run=RUN,
)
CASES = {
    "masses on two spans": MASSES,
    "eccentric masses": dataclasses.replace(
        MASSES,
        beam=dataclasses.replace(
            BEAM, modes=6, damping_ratio=0.02, torsional_rigidity=4.0, polar_inertia=2e-4
        ),
        sensors=(
            jb.Sensor(0.3, "twist"),
            jb.Sensor(0.4, "torque"),
        ),
        loads=[dataclasses.replace(load, eccentricity=0.02) for load in MASSES.loads],
    ),
    "a table of positions": dataclasses.replace(
        MASSES, supports=(), loads=(jb.MovingMass(mass=0.1, **TABLE),)
    ),
    "forces": dataclasses.replace(
        MASSES, loads=(jb.MovingForce(force=3.0, speed=6.0), jb.MovingForce(mass=0.2, **TABLE))
    ),
    "vehicles": dataclasses.replace(
        MASSES,
        loads=(
            jb.QuarterCar(0.3, 0.02, 60.0, 0.6, 400.0, 0.1, speed=6.0, start_position=-0.2),
            jb.Oscillator(0.1, 40.0, 0.2, 0.01, speed=-5.0, entry_time=0.05, deceleration=8.0),
        ),
        profile=jb.profiles.BumpProfile(-0.15, 0.4, 1e-3),
    ),
    "no loads": dataclasses.replace(MASSES, loads=()),
    "coupled": dataclasses.replace(
        MASSES,
        supports=(jb.Support(0.5, stiffness=3e3, damping=2.0),),
        actuators=(
            jb.SpringDamper(0.3, 500.0, 1.5),
            jb.Patch(0.6, 0.8, 1e-3, added_mass=0.05, added_rigidity=2.0),
            jb.Shaker(0.9, stiffness=200.0),
            jb.Electrodynamic(0.35, resistance=2.0, inductance=1e-3, force_constant=4.0, mass=0.03),
        ),
    ),
}


def _model(case, layout):
    return modal_model(case, layout, has_coupling(case))


def _forces_on_the_beam(case, layout):
    """Contact forces and accelerations at some instants, for arbitrary states."""
    model, loads, times = _model(case, layout), load_set(case), np.linspace(0.01, 0.2, 7)
    count = model.state_count + loads.vehicle_states
    states = 1e-3 * np.sin(np.arange(times.size * count)).reshape(times.size, -1, 1)
    return contact_at(model, loads, times, states)


def _discrete_model(case, layout):
    model = _model(case, layout)
    grid = grid_by_step_length(case, model, np.float64(0.004))
    return grid, discrete_model(model, grid, case.sensor_positions)


X = np.array([0.1, 0.45, 0.77])
FUNCTIONS = {
    "modes": lambda case, layout: jb.modes(case, layout),
    "mode shapes": lambda case, layout: jb.modes(case, layout).shape_derivatives(X, (0, 1, 2)),
    "modal model": _model,
    "full modal model": lambda case, layout: modal_model(case, layout),
    "contact": _forces_on_the_beam,
    "propagators": lambda case, layout: propagators(
        _model(case, layout), np.array([0.0, 1e-4, 0.01]), with_commands=has_coupling(case)
    ),
    "longest step": lambda case, layout: max_stable_step(_model(case, layout), load_set(case)),
    "discrete model": _discrete_model,
    "output rows": lambda case, layout: sensor_rows(_model(case, layout), case, case.sensors),
    "flexibility": lambda case, layout: flexibility(case, layout, X, 0)(X / 1.2, 0),
    "influence line": lambda case, layout: [
        jb.influence_line(case, X, X[:2, None], derivative, layout) for derivative in (0, 2, 3)
    ],
    "influence at a point": lambda case, layout: jb.influence_line(case, 0.3, 0.8, layout=layout),
    "static deflection": lambda case, layout: jb.statics.static_deflection(
        case, X, X[:2], np.array([2.0, -1.0]), layout=layout
    ),
    "deflection per command": lambda case, layout: static_deflection_per_command(
        case, X, layout=layout
    ),
    "static peak": lambda case, layout: jb.statics.static_peak(case, X, layout),
    "frequency response": lambda case, layout: jb.frequency_response(
        case,
        np.array([1.0, 20.0, 70.0]),
        [("force@0.3", "velocity@0.7")],
        stationary_masses=[(0.3, 0.2)],
        layout=layout,
    ),
    "receptance": lambda case, layout: jb.frequency_responses.receptance(
        case, np.array([5.0, 40.0]), 0.3, 0.7, layout=layout
    ),
    "state space": lambda case, layout: [
        jb.state_space(case, layout=layout).at(t) for t in (0.01, 0.06)
    ],
}


def both_ways(function, case: jb.Case, **settings: bool | int):
    """Arrays that a function of a case returns with its numbers known, and with them traced.

    Programs are compiled with low optimisation, or with other `settings` of the compiler.
    """
    numbers, rest = eqx.partition(case, eqx.is_array)

    def arrays(numbers):
        return eqx.filter(function(eqx.combine(numbers, rest)), eqx.is_array)

    known = arrays(numbers)
    assert not any_jax(known), "known numbers give arrays of NumPy"
    # Run once each: the full optimisation of the default takes five times as long.
    options = xla_options(**(settings or LOW_OPTIMISATION))
    return known, jax.jit(arrays, compiler_options=options)(numbers)


def assert_equal(known, traced, tolerance=TOLERANCE):
    """Equal structure, and arrays that agree to a tolerance; infinite and missing entries alike."""
    known, traced = (jax.tree.leaves_with_path(tree) for tree in (known, traced))
    assert [path for path, _ in known] == [path for path, _ in traced]
    for (path, ours), (_, theirs) in zip(known, traced, strict=True):
        scale = np.max(np.abs(theirs), initial=0.0, where=np.isfinite(theirs))
        name = jax.tree_util.keystr(path)
        own = CANCELLED_TOLERANCE if name.endswith(CANCELLED) else tolerance
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=own * scale, err_msg=name)


OF_LOADS = ("contact", "longest step", "discrete model", "static peak", "state space")
PAIRS = [
    (function, name)
    for function in FUNCTIONS
    for name in (CASES if function in OF_LOADS else ("masses on two spans", "coupled"))
    if (function, name) != ("longest step", "no loads")  # no load limits it
]


@pytest.mark.parametrize(("function", "name"), PAIRS)
def test_known_and_traced_numbers_give_the_same(function, name):
    case, layout = CASES[name], mesh_layout(CASES[name])
    assert_equal(*both_ways(lambda case: FUNCTIONS[function](case, layout), case))


@pytest.mark.parametrize("name", CASES)
def test_records_of_known_and_traced_numbers_are_the_same(name):
    """Histories of the modes and of every quantity at the sensors, contact forces and peaks."""
    plan, times = integration_plan(CASES[name]), sample_times(CASES[name])

    def errors(record):
        return record.error_estimate, record.step_errors

    def simulate(case):
        record = jb.simulate(case, times, plan)
        # A known run takes the steps of its peaks as two halves, for their errors.
        record = eqx.tree_at(errors, record, (np.zeros(()), np.zeros(len(case.sensors))))
        histories = [record.at(0.33, sensor.quantity, 1e-3, 1e-6) for sensor in SENSORS]
        left = record.shear_force(0.33, "left")
        return record, histories, record.measured, record.strain, left, record.reactions

    # Run for longer than compiled if not optimised; so are the peaks below.
    assert_equal(*both_ways(simulate, CASES[name], xla_backend_optimization_level=2))


@pytest.mark.parametrize("name", ["masses on two spans", "forces", "coupled", "vehicles"])
def test_peaks_of_known_and_traced_numbers_are_the_same(name):
    case = CASES[name]
    shapes = static_shapes(case)

    def peaks(case):
        return run_peaks(case, shapes, np.float64(2e-3), case.sensor_positions).peaks()

    # This program runs for longer without optimisation than it compiles.
    assert_equal(*both_ways(peaks, case, xla_backend_optimization_level=2))


@pytest.mark.parametrize(
    "reading",
    [
        {"resolution": 1e-6, "range": [-1.0, 1.0], "offset": 0.2},
        {"delay": 0.004, "sampling_period": 0.01},
        {"filter": Filter(40.0, 2)},
        {"noise": 1e-6},
    ],
    ids=["quantised", "delayed", "filtered", "noisy"],
)
def test_readings_of_known_and_traced_numbers_are_the_same(reading):
    case = dataclasses.replace(MASSES, sensors=(jb.Sensor(0.3, **reading),))
    plan, times = integration_plan(case), sample_times(case)
    assert_equal(*both_ways(lambda case: jb.simulate(case, times, plan).measured, case))


PATCH = jb.Patch(0.6, 0.8, 1e-2, depolarisation=[-30.0, 30.0])
CONTROLLED = dataclasses.replace(
    MASSES,
    beam=dataclasses.replace(BEAM, modes=3, damping_ratio=0.02),
    supports=(),
    actuators=(PATCH,),
    sensors=(jb.Sensor(0.4), jb.Sensor(0.7, delay=0.002, filter=Filter(40.0, 2))),
    loads=(
        jb.MovingMass(mass=0.1, speed=6.0),
        jb.QuarterCar(0.3, 0.02, 60.0, 0.6, 400.0, 0.1, speed=6.0, start_position=-0.2),
    ),
    run=jb.Run(duration=0.06, sample_rate=200.0),
)
WEIGHTS = {"state_weight": [1e6] * 6, "command_weight": [1.0], "period": 0.005}
NOISE = {"process_noise": 0.02, "measurement_noise": 1e-4}
PREDICTIVE = {"horizon": 4, "moves": 2, "move_weight": 1e-7, "period": 0.005, "positions": [0.5]}
LAWS = {
    "feedback": jb.Feedback(gains=[2e3], period=0.005),
    "LQR": jb.LQR(**WEIGHTS, sampling="exact"),
    "loads ignored by the filter": jb.LQR(
        **WEIGHTS, estimator=jb.Kalman(**NOISE), sampling="exact"
    ),
    "loads known by the filter": jb.LQR(
        **WEIGHTS, delay=0.001, estimator=jb.Kalman(**NOISE, loads="known"), sampling="exact"
    ),
    "weights estimated, fed forward": jb.MPC(
        **PREDICTIVE,
        loads="known",
        estimator=jb.Kalman(**NOISE, loads="estimated", weight_deviation=1.0),
    ),
    "prediction with masses": jb.MPC(
        **PREDICTIVE, prediction="time-varying", delay=0.001, soft_limit=1e-4, terminal="riccati"
    ),
}
# The models of filters and predictions agree to 1e-15, gains from a Riccati equation to 1e-11 of
# the largest, quadratic programs as they are solved; in a command their products cancel.
LAW_TOLERANCE = 1e-9


@pytest.mark.parametrize("name", LAWS)
def test_steps_of_known_and_traced_laws_are_the_same(name):
    """Commands at two samples: of the designed law, and of known numbers with its tables too.

    Tables of gains are those of a filter from the first sample on.
    """
    case = dataclasses.replace(CONTROLLED, controller=LAWS[name])
    layout, period = mesh_layout(case), 0.005

    def commands(case, with_tables, samples=(10, 11)):
        plant = jb.state_space(case, layout=layout)
        law, sent = case.controller.law(plant), [np.zeros(1)]
        law = law.tabulated(np.arange(20) * period) if with_tables else law
        state = law.initial_state()
        for i, sample in enumerate(samples):
            readings = 1e-4 * np.array([i + 1.0, 2.0 - i])
            true_state = 1e-3 * np.sin(np.arange(6.0) + i)
            measurement = Measurement(readings, true_state, sent[-1])
            command, state, _ = law.step(state, measurement, sample * np.float64(period))
            sent.append(command)
        return xp.concatenate(sent)

    known, traced = both_ways(lambda case: commands(case, False), case)
    assert_equal(known, traced, LAW_TOLERANCE)
    parts = (commands(case, with_tables, range(12)) for with_tables in (False, True))
    assert_equal(*parts, LAW_TOLERANCE)


NO_PROGRAM = {
    "modes": "jb.modes(case)",
    "an open loop": "jb.simulate(case)",
    "another number of loads and modes": "jb.simulate(other)",
    **{name: f"jb.simulate(laws[{i}])" for i, name in enumerate(LAWS)},
    "poles of a loop": "frozen_poles(laws[0], np.array([0.0, 0.02])).poles",
    "its growth": "growth(laws[0])",
    "its margins": "stability_margin(laws[1])",
}


def test_plain_calls_compile_nothing(tmp_path):
    jb.save_case(MASSES, tmp_path / "case.toml")
    for i, controller in enumerate(LAWS.values()):
        jb.save_case(dataclasses.replace(CONTROLLED, controller=controller), tmp_path / f"{i}.toml")
    lines = [f"print({name!r}, file=sys.stderr); {call}" for name, call in NO_PROGRAM.items()]
    code = (
        "import jax; jax.config.update('jax_log_compiles', True)\n"
        "import dataclasses, sys, numpy as np, jaxbeam as jb\n"
        "from jaxbeam.analysis.stability import stability_margin\n"
        "from jaxbeam.analysis.stability import frozen_poles, growth\n"
        "case = jb.load_case('case.toml')\n"
        "beam = dataclasses.replace(case.beam, modes=7, damping_ratio=0.01)\n"
        "other = dataclasses.replace(case, beam=beam, loads=case.loads[:2])\n"
        f"laws = [jb.load_case(f'{{i}}.toml') for i in range({len(LAWS)})]\n"
    ) + "\n".join(lines)
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=tmp_path
    )
    assert ended.returncode == 0, ended.stderr
    printed = [line for line in ended.stderr.splitlines() if line in NO_PROGRAM or "ompil" in line]
    assert printed == list(NO_PROGRAM), "no program between the names of the calls"


LOOP = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.3)],
    actuators=[jb.PointForce(0.3)],
    loads=[jb.MovingMass(mass=0.4, speed=2.0)],
    controller=jb.Feedback([200.0]),
    run=jb.Run(0.3),
)
SPEEDS = {"loads.0.speed": [2.0, 3.0]}
# Their derivatives had been zero, or an error of JAX.
REFUSED = {
    "a sweep": lambda case, _: jb.sweep(case, SPEEDS, progress=False).peak_deflection.values.sum(),
    "a sweep over values": lambda _, mass: jb.sweep(
        LOOP, {"loads.0.mass": [0.3, mass]}, progress=False
    ).peak_deflection.values.sum(),
    "an assessment": lambda case, _: jb.assess(case, 30.0).checks[0].value,
    "a check": lambda case, _: jb.check(case).speed_ratio,
    "the stability of a loop": lambda case, _: frozen_poles(case).largest_real_part.max(),
    "the stability of a loop over a crossing": lambda case, _: growth(case).factor.max(),
    "the stability of a loop in a stream": lambda case, _: stream(case, 0.4).largest_multiplier,
}


@pytest.mark.parametrize("what", REFUSED)
@pytest.mark.parametrize("transform", [jax.grad, jax.jit])
def test_what_has_no_derivative_is_refused_in_a_sentence(what, transform):
    def function(mass):
        return REFUSED[what](jb.replace(LOOP, {"loads.0.mass": mass}), mass)

    named = " ".join(what.split()[:2])
    with pytest.raises(ValueError, match=f"{named}.* neither differentiated nor compiled: call it"):
        transform(function)(0.4)
