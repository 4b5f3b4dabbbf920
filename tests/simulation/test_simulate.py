"""Runs against closed forms and independent modal equations, contact, peaks, and invalid times.

Random crossings against the modal equations, integrated by scipy: deflections and stated errors.
Masses to a hundred times the beam's and speeds to ten times the critical one; one to eight modes;
loads that enter together, follow, meet or stop on the beam.
"""

import dataclasses
import json
import tomllib
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.integration_plan import static_shapes
from jaxbeam.simulation.integrator.discrete_model import discrete_model
from jaxbeam.simulation.integrator.integrate import integrate_history
from jaxbeam.simulation.integrator.time_grid import grid_by_step_length
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.differences import assert_close, load_of, plan_of
from tests.fuzzing import examples
from tests.modules import DATA
from tests.oracles import crossing, finite_elements, modal_equations
from tests.oracles.closed_forms import (
    critical_speed,
    moving_force,
)
from tests.oracles.crossing import GRAVITY, Load
from tests.oracles.modal_equations import Span

SPAN = Span(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=4, damping_ratio=0.02)
SENSORS = [0.15, 0.4]
TIMES = np.linspace(0.0, 1.0, 101)


def case_of(span: Span, loads: list[Load], **options) -> jb.Case:
    """Case of the span and loads of an oracle."""
    beam = jb.Beam(
        span.length,
        span.flexural_rigidity,
        span.mass_per_length,
        span.damping_ratio,
        modes=span.modes,
    )
    return jb.Case(
        beam,
        sensors=[jb.Sensor(x) for x in SENSORS],
        loads=[load_of(load) for load in loads],
        run=jb.Run(1.0, gravity=GRAVITY),
        **options,
    )


def random_load(rng: np.random.Generator, kind: str = "mass") -> Load:
    """Load of random direction, deceleration and entry time; it may stop or never enter."""
    speed = rng.uniform(0.8, 4.0)
    stopping = speed**2 / (2 * SPAN.length * rng.uniform(0.3, 0.9))
    return Load(
        mass=rng.uniform(0.05, 0.5),
        speed=speed * rng.choice([-1, 1]),
        entry_time=rng.uniform(-0.1, 0.5),
        deceleration=rng.choice([0.0, stopping, -2.0, 0.5 * stopping]),
        kind=kind,
    )


@pytest.fixture(scope="module")
def one_mass():
    """Function that simulates one mass on the span; all runs share one plan."""
    case = case_of(SPAN, [Load(0.3, 1.0)])
    plan = plan_of(case)

    def run(load: Load, times=TIMES, plan=plan, **numbers):
        changed = eqx.tree_at(lambda c: c.loads, case, (load_of(load),))
        return jb.simulate(jb.replace(changed, numbers), jnp.asarray(times), plan)

    return run


pytestmark = pytest.mark.filterwarnings(
    # the model is bilateral, the oracles too
    "ignore::jaxbeam.simulation.simulate.ContactLossWarning"
)

# Independent modal equations


LOADS = [random_load(np.random.default_rng(seed)) for seed in range(4)] + [
    Load(0.3, 2.0, entry_time=1.2),  # after the run
    Load(0.3, -2.0, entry_time=-0.2),  # at midspan at the start of the run
    Load(0.3, 1.0, entry_time=-0.7),  # before the run
]


@pytest.mark.parametrize("load", LOADS, ids=str)
def test_one_mass_agrees_with_modal_equations(one_mass, load):
    record = one_mass(load)
    expected = modal_equations.respond(SPAN, [load], SENSORS, TIMES)
    assert_close(record.deflection, expected.deflection, 1e-9)
    assert_close(record.rates, expected.modal_rate, 1e-7)
    assert_close(record.contact_force, expected.contact_force, 1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_masses_and_force_agree_with_modal_equations(stream, seed):
    rng = np.random.default_rng(100 + seed)
    loads = [random_load(rng, kind) for kind in ("mass", "force", "mass")]
    record = stream(loads)
    expected = modal_equations.respond(SPAN, loads, SENSORS, TIMES)
    assert_close(record.deflection, expected.deflection, 1e-8)
    assert_close(record.contact_force, expected.contact_force, 1e-6)


@pytest.fixture(scope="module")
def stream():
    """Function that simulates two masses and a force on the span."""
    case = case_of(SPAN, [Load(0.3, 1.0), Load(0.3, 1.0, kind="force"), Load(0.3, 1.0)])
    plan = plan_of(case, max_loads=3)

    def run(loads: list[Load]):
        changed = eqx.tree_at(lambda c: c.loads, case, tuple(load_of(load) for load in loads))
        return jb.simulate(changed, jnp.asarray(TIMES), plan)

    return run


def test_table_of_positions_gives_the_sampled_trajectory(one_mass):
    """A cubic spline reproduces the parabola of a braking load."""
    load = Load(0.3, 1.5, 0.05, deceleration=0.7)
    times = np.linspace(0.05, 0.6, 7)
    table = jb.MovingMass(
        0.3, times=times, positions=[load.motion(t, 0.6, False)[0] for t in times]
    )
    case = eqx.tree_at(lambda c: c.loads, case_of(SPAN, [load]), (table,))
    assert table.positions[-1] > 0.6
    record = jb.simulate(case, jnp.asarray(TIMES), plan_of(case))
    assert_close(record.deflection, one_mass(load).deflection, 1e-10)
    assert_close(record.contact_force, one_mass(load).contact_force, 1e-9)


# Energy, contact, peaks, samples


def test_contact_loss_is_reported_once(one_mass):
    load = Load(0.6, 8.0)
    times = np.linspace(0.0, 0.2, 101)
    with pytest.warns(ContactLossWarning, match="load 0 loses contact") as caught:
        record = one_mass(load, times)
    assert len(caught) == 1
    fine = np.linspace(0.0, SPAN.length / load.speed, 20001)[:-1]
    force = modal_equations.respond(SPAN, [load], SENSORS, fine).contact_force[:, 0]
    first = fine[np.argmax(force < 0)]
    assert force.min() < -1.0
    assert_allclose(record.contact_lost_time[0], first, atol=fine[1])
    assert_allclose(record.contact_lost_position[0], 8.0 * record.contact_lost_time[0], rtol=1e-12)
    assert_allclose(record.lowest_contact_force[0], force.min(), rtol=1e-4)
    assert f"t = {float(record.contact_lost_time[0]):.4g} s" in record.verdict


def test_no_warning_without_contact_loss(one_mass):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record = one_mass(Load(0.1, 1.0))
    assert np.isnan(record.contact_lost_time[0]) and record.lowest_contact_force[0] > 0


@pytest.mark.parametrize("speed", [1.3, 4.0, 9.0])
def test_peaks_are_those_in_continuous_time(one_mass, speed):
    """At low speed during the crossing, at high speed after it."""
    load = Load(0.2, speed, 0.013)
    record = one_mass(load)
    fine = np.linspace(0.0, 1.0, 40001)
    deflection = np.abs(modal_equations.respond(SPAN, [load], SENSORS, fine).deflection)
    assert_allclose(record.peak_deflection, vertex(deflection), rtol=1e-9)
    when = fine[np.argmax(deflection, axis=0)]
    assert_allclose(record.peak_time, when, rtol=0, atol=fine[1])


def vertex(samples: np.ndarray) -> np.ndarray:
    """Height of the parabola through the largest sample and its neighbours, for each column."""
    top, column = np.argmax(samples, axis=0), np.arange(samples.shape[1])
    before, middle, after = (samples[top + d, column] for d in (-1, 0, 1))
    return middle - (after - before) ** 2 / (8 * (before - 2 * middle + after))


def test_order_of_convergence_is_twice_the_number_of_nodes():
    """Against the modal equations, with the mass still on the beam."""
    span, load = dataclasses.replace(SPAN, modes=2), Load(0.5, 1.5)
    case = jb.replace(case_of(span, [load]), {"run.duration": 0.32})
    shapes = static_shapes(case)

    @eqx.filter_jit
    def end_state(max_step):
        model = modal_model(case, shapes.layout, shapes.coupled)
        grid = grid_by_step_length(case, model, max_step)
        discrete = discrete_model(model, grid, None)
        return integrate_history(discrete, load_set(case), max_loads=1, steps=64)[1][-1, :, 0]

    counts = np.array([24, 32, 48, 64])
    expected = modal_equations.respond(span, [load], SENSORS, np.array([0.0, 0.32])).modal[1]
    ends = [np.abs(end_state(jnp.array(0.32 / n)))[0:4:2] for n in counts]
    errors = [np.max(np.abs(found - np.abs(expected))) / np.abs(expected).max() for found in ends]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert 11 < order < 13


# Invalid times


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0], "at least two"),
        ([0.0, 0.2, 0.1], "ascend"),
        ([0.0, np.nan], "finite"),
    ],
)
def test_invalid_times_are_refused(times, message):
    with pytest.raises(ValueError, match=message):
        jb.simulate(case_of(SPAN, [Load(0.3, 1.0)]), jnp.asarray(times))


def deflections_under_a_force(times):
    """Deflections (m) at some times under a force on the beam at the start."""
    case = jb.Case(
        jb.Beam(10.0, 4e7, 2000.0, damping_ratio=0.02, modes=4),
        sensors=[jb.Sensor(5.0)],
        loads=[jb.MovingForce(force=3e4, speed=8.0, entry_time=-0.2)],
        run=jb.Run(1.0),
    )
    return jb.simulate(case, times=np.asarray(times)).deflection[:, 0]


def deflection_by_modes(times):
    """By scipy: q'' + 2 zeta w q' + w^2 q = -P phi(x) of each mode from rest at t = 0."""
    n = np.arange(1, 5) * np.pi / 10.0
    w, shapes = n**2 * (4e7 / 2000.0) ** 0.5, (2 / 2e4) ** 0.5

    def rates(t, y):
        q, slope = y.reshape(2, 4)
        force = -3e4 * shapes * np.sin(n * 8.0 * (t + 0.2))
        return np.concatenate([slope, force - 0.04 * w * slope - w**2 * q])

    found = solve_ivp(rates, (0, times[-1]), np.zeros(8), t_eval=times, rtol=1e-10, atol=1e-14)
    return shapes * np.sin(n * 5.0) @ found.y[:4]


@pytest.mark.parametrize("times", [[0.25, 0.35], [0.05, 0.15, 0.25], [0.7 - 1e-8, 0.7]])
def test_first_sample_at_any_time(times):
    """Whatever comes before it, runs start at t = 0, and close samples late take no long lead."""
    assert_allclose(deflections_under_a_force(times), deflection_by_modes(times), rtol=1e-6)


@pytest.fixture(scope="module")
def one_force():
    """Function that simulates a force of 3 N on the undamped span for two crossing times."""
    case = case_of(UNDAMPED, [Load(3.0 / GRAVITY, 1.0, kind="force")])
    plan = plan_of(case)

    def run(speed):
        times = np.linspace(0.0, 2 * SPAN.length / speed, 101)
        return jb.simulate(jb.replace(case, {"loads.0.speed": speed}), jnp.asarray(times), plan)

    return run


UNDAMPED = dataclasses.replace(SPAN, damping_ratio=0.0)


@pytest.mark.filterwarnings(
    # the model is bilateral, the oracles too
    "ignore::jaxbeam.simulation.simulate.ContactLossWarning"
)
@pytest.mark.parametrize("ratio", [0.05, 0.3, 1.0, 1.0 + 1e-9, 2.0, 3.7])
def test_moving_force_has_its_closed_form_at_every_speed(one_force, ratio):
    record = one_force(ratio * critical_speed(UNDAMPED))
    q, u = moving_force(UNDAMPED, 3.0, ratio * critical_speed(UNDAMPED), np.asarray(record.times))
    assert_close(record.deflection, q @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)
    assert_close(record.velocity, u @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)


LENGTH, RIGIDITY, MASS_PER_LENGTH = 2.0, 50.0, 1.5
CRITICAL_SPEED = np.pi / LENGTH * np.sqrt(RIGIDITY / MASS_PER_LENGTH)  # of the first mode, m/s
PERIOD = 2 * LENGTH / CRITICAL_SPEED  # of the first mode, s
ROUNDING = 1e-9  # of the largest deflection; scipy is no more accurate


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log10(low), np.log10(high)).map(lambda exponent: 10.0**exponent)


@st.composite
def travelling(draw) -> Load:
    """A load that crosses, or brakes to a stop on the beam."""
    speed = draw(logarithmic(0.05, 10.0)) * CRITICAL_SPEED * draw(st.sampled_from([1, -1]))
    stop = draw(st.sampled_from([None, None, None, 0.3, 0.5, 0.9]))  # share of the beam
    return Load(
        mass=draw(logarithmic(1e-3, 100.0)) * MASS_PER_LENGTH * LENGTH,
        speed=speed,
        entry_time=draw(st.sampled_from([0.0, 0.0, 0.1, 0.7])) * PERIOD,
        deceleration=0.0 if stop is None else speed**2 / (2 * stop * LENGTH),
        kind=draw(st.sampled_from(["mass", "mass", "force"])),
    )


@st.composite
def crossings(draw) -> tuple[modal_equations.Span, list[Load], float]:
    """Span, loads and duration (s)."""
    damping = draw(st.sampled_from([0.0, 0.01, 0.1]))
    span = modal_equations.Span(LENGTH, RIGIDITY, MASS_PER_LENGTH, draw(st.integers(1, 8)), damping)
    loads = draw(st.lists(travelling(), min_size=1, max_size=3))
    ends = [min(load.time_at(LENGTH), load.stop_time) for load in loads]
    return span, loads, max(ends) + draw(st.sampled_from([0.1, 2.0])) * PERIOD


def crossing_case(span, loads, duration) -> jb.Case:
    """The same crossing in jaxbeam."""
    kinds = {"mass": jb.MovingMass, "force": jb.MovingForce}
    return jb.Case(
        jb.Beam(
            LENGTH, RIGIDITY, MASS_PER_LENGTH, damping_ratio=span.damping_ratio, modes=span.modes
        ),
        sensors=[jb.Sensor(0.37 * LENGTH), jb.Sensor(0.5 * LENGTH)],
        loads=[
            kinds[load.kind](
                mass=load.mass,
                speed=load.speed,
                entry_time=load.entry_time,
                deceleration=load.deceleration,
            )
            for load in loads
        ],
        run=jb.Run(duration, sample_rate=60.0 / duration),
    )


@settings(max_examples=examples(8))
@given(crossings())
def test_deflections_agree_with_scipy_within_the_stated_error(crossing):
    span, loads, duration = crossing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        record = jb.simulate(crossing_case(span, loads, duration))
    positions = np.array([0.37, 0.5]) * LENGTH
    expected = modal_equations.respond(span, loads, positions, np.asarray(record.times)).deflection
    size = np.abs(expected).max()
    stated = float(record.error_estimate)
    assert np.isfinite(stated) and stated <= 1e-6
    assert_allclose(record.deflection, expected, rtol=0, atol=max(stated, ROUNDING) * size)


# Runs with very heavy and very fast masses, and with very many modes.


def test_slow_load_on_two_hundred_modes_is_near_statics():
    """The peak is at most that of a load applied suddenly, twice the static one."""
    case = jb.Case(
        jb.Beam(6.0, 1168.0, 5.35, damping_ratio=0.05, modes=200),
        sensors=[jb.Sensor(3.0)],
        loads=[jb.MovingMass(mass=0.5, times=[0.0, 0.2], positions=[2.99, 3.01])],
        run=jb.Run(0.2, sample_rate=100.0),
    )
    record = jb.simulate(case)
    assert np.isfinite(np.asarray(record.deflection)).all()
    assert record.peak_deflection[0] < 2.001 * static_peak(case, np.array([3.0]))[0]


# Cases of many parts against finite elements, mirror images and the reference implementation.

REFERENCE = json.loads((DATA / "reference_cases.json").read_text("utf-8"))


@pytest.mark.parametrize("reference", REFERENCE, ids=lambda reference: reference["title"])
def test_reference_cases(reference):
    record = jb.simulate(case_from_dict(tomllib.loads(reference["case_toml"])))
    assert_allclose(record.modes.frequencies, reference["natural_frequencies_hz"], rtol=1e-9)
    deflection = record.deflection[np.array(reference["sample_index"])]
    assert_close(deflection, reference["deflection_m"], 1e-7)
    largest = reference["largest_sampled_abs_deflection_m"]
    assert_allclose(np.max(np.abs(record.deflection), axis=0), largest, rtol=1e-6)
    assert np.all(record.peak_deflection >= np.array(largest) * (1 - 1e-9))


GENERAL = finite_elements.Beam(
    length=1.3,
    flexural_rigidity=12.0,
    mass_per_length=0.7,
    ends="guided-free",
    supports=[
        finite_elements.Support(0.3, 5000.0, 6.0, 3.0),
        finite_elements.Support(0.78),
        finite_elements.Support(1.1, 2000.0, 4.0),
    ],
    patches=[finite_elements.Patch(0.4, 0.6, 5.0, 0.4)],
    suspensions=[finite_elements.Suspension(0.52, 3000.0, 25.0)],
    damping_ratio=[0.01, 0.03, 0.02, 0.01],
    elements=130,
)


def case_on(beam: finite_elements.Beam, loads: list[Load], modes: int, sensors) -> jb.Case:
    """Case of a finite-element beam."""
    return jb.Case(
        jb.Beam(
            beam.length,
            beam.flexural_rigidity,
            beam.mass_per_length,
            beam.damping_ratio,
            beam.ends,
            modes,
        ),
        supports=[jb.Support(**vars(support)) for support in beam.supports],
        actuators=[
            *(
                jb.Patch(
                    p.start,
                    p.end,
                    1e-3,
                    added_mass=p.mass_per_length,
                    added_rigidity=p.flexural_rigidity,
                )
                for p in beam.patches
            ),
            *(jb.Shaker(s.position, s.stiffness, s.damping) for s in beam.suspensions),
        ],
        sensors=[jb.Sensor(x) for x in sensors],
        loads=[load_of(load) for load in loads],
        run=jb.Run(1.0, gravity=GRAVITY),
    )


def mirrored(beam: finite_elements.Beam) -> finite_elements.Beam:
    """Mirror image of the beam."""

    def flip(parts, *names):
        positions = [{n: beam.length - getattr(part, n) for n in names} for part in parts]
        return [dataclasses.replace(p, **x) for p, x in zip(parts, positions, strict=True)]

    return dataclasses.replace(
        beam,
        ends="-".join(reversed(beam.ends.split("-"))),
        supports=flip(beam.supports, "position"),
        patches=[
            dataclasses.replace(p, start=beam.length - p.end, end=beam.length - p.start)
            for p in beam.patches
        ],
        suspensions=flip(beam.suspensions, "position"),
    )


def test_general_case_agrees_with_finite_elements_and_mirror_image():
    """Unequal spans, elastic and damped supports, patch, suspension; masses in both directions."""
    loads = [Load(0.3, 2.5, 0.02, deceleration=4.0), Load(0.2, -3.0, 0.1, deceleration=-1.0)]
    times, sensors = np.linspace(0.0, 0.8, 81), np.array([0.2, 0.6, 1.3])
    case = case_on(GENERAL, loads, 4, sensors)
    record = jb.simulate(case, jnp.asarray(times), plan_of(case))
    expected = crossing.respond(GENERAL, loads, sensors, times, modes=4, rtol=1e-9)
    assert_close(record.deflection, expected.deflection, 2e-6)
    assert_close(record.velocity, expected.velocity, 1e-4)
    assert_close(record.contact_force, expected.contact_force, 1e-4)

    reversed_loads = [dataclasses.replace(load, speed=-load.speed) for load in loads]
    other = case_on(mirrored(GENERAL), reversed_loads, 4, GENERAL.length - sensors)
    image = jb.simulate(other, jnp.asarray(times), plan_of(other))
    assert_close(image.deflection, record.deflection, 1e-9)
    assert_close(image.contact_force, record.contact_force, 1e-8)
    assert_allclose(image.load_position, GENERAL.length - record.load_position, rtol=1e-12)


SPRINGS = [finite_elements.Support(x, 3000.0, 5.0) for x in (0.2, 0.9)]


@pytest.mark.parametrize(
    ("ends", "supports", "speed"),
    [
        ("clamped-free", [], 4.0),  # exit at the free end
        ("clamped-free", [], -4.0),  # entry at the free end
        ("free-free", SPRINGS, 3.0),
        ("clamped-guided", [], 5.0),
        ("free-pinned", [SPRINGS[0]], -3.0),
    ],
)
def test_all_end_conditions_agree_with_finite_elements(ends, supports, speed):
    """Deflection and contact force."""
    beam = finite_elements.Beam(
        1.2, 12.0, 0.7, ends, supports=supports, damping_ratio=0.02, elements=100
    )
    loads, times, sensors = [Load(0.3, speed, 0.02)], np.linspace(0.0, 0.8, 81), [0.5, 1.2]
    case = case_on(beam, loads, 3, sensors)
    record = jb.simulate(case, jnp.asarray(times), plan_of(case))
    expected = crossing.respond(beam, loads, sensors, times, modes=3, rtol=1e-9)
    assert_close(record.deflection, expected.deflection, 2e-6)
    assert_close(record.contact_force, expected.contact_force, 1e-4)
