"""Runs against closed forms, modal equations written separately, conservation laws and limits.

Cases that share a structure share a plan here, made by hand, so that each is compiled once.
"""

import dataclasses
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import integrate_history
from jaxbeam.integrator.time_grid import grid_by_step_length
from jaxbeam.model.contact import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.simulation.integration_plan import static_shapes
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.oracles import modal_equations
from tests.oracles.closed_forms import (
    cancellation_speed,
    critical_speed,
    influence_line,
    moving_force,
)
from tests.oracles.loads import GRAVITY, Load
from tests.oracles.modal_equations import Span
from tests.runs import assert_close, load_of, plan_of

pytestmark = pytest.mark.filterwarnings(
    # the model is bilateral, the oracles too
    "ignore::jaxbeam.simulation.simulate.ContactLossWarning"
)

SPAN = Span(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=4, damping_ratio=0.02)
SENSORS = [0.15, 0.4]
TIMES = np.linspace(0.0, 1.0, 101)


def case_of(span: Span, loads: list[Load], **options) -> jb.Case:
    """The case of an oracle's span and loads."""
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
    """A load that may travel either way, brake, stop or speed up; enter early, late or never."""
    speed = rng.uniform(0.8, 4.0)
    stopping = speed**2 / (2 * SPAN.length * rng.uniform(0.3, 0.9))
    return Load(
        mass=rng.uniform(0.05, 0.5),
        speed=speed * rng.choice([-1, 1]),
        entry_time=rng.uniform(-0.1, 0.5),
        deceleration=rng.choice([0.0, stopping, -2.0, 0.5 * stopping]),
        kind=kind,
    )


# The modal equations, written separately


@pytest.fixture(scope="module")
def one_mass():
    """Simulate one mass on the span: all these runs share one plan."""
    case = case_of(SPAN, [Load(0.3, 1.0)])
    plan = plan_of(case)

    def run(load: Load, times=TIMES, plan=plan, **numbers):
        changed = eqx.tree_at(lambda c: c.loads, case, (load_of(load),))
        return jb.simulate(jb.replace(changed, numbers), jnp.asarray(times), plan)

    return run


LOADS = [random_load(np.random.default_rng(seed)) for seed in range(8)] + [
    Load(0.3, 2.0, entry_time=1.2),  # after the run
    Load(0.3, -2.0, entry_time=-0.2),  # in the middle of the beam as the run starts
    Load(0.3, 1.0, entry_time=-0.7),  # has left before
]


@pytest.mark.parametrize("load", LOADS, ids=str)
def test_one_mass_agrees_with_the_modal_equations(one_mass, load):
    record = one_mass(load)
    expected = modal_equations.respond(SPAN, [load], SENSORS, TIMES)
    assert_close(record.deflection, expected.deflection, 1e-9)
    assert_close(record.rates, expected.modal_rate, 1e-7)
    assert_close(record.contact_force, expected.contact_force, 1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_masses_and_a_force_at_once_agree_with_the_modal_equations(stream, seed):
    rng = np.random.default_rng(100 + seed)
    loads = [random_load(rng, kind) for kind in ("mass", "force", "mass")]
    record = stream(loads)
    expected = modal_equations.respond(SPAN, loads, SENSORS, TIMES)
    assert_close(record.deflection, expected.deflection, 1e-8)
    assert_close(record.contact_force, expected.contact_force, 1e-6)


def test_a_stream_of_three_masses_at_once_agrees_with_the_modal_equations(stream):
    loads = [Load(0.3, 1.5, 0.05), Load(0.2, 1.5, 0.15, kind="force"), Load(0.4, 1.5, 0.25)]
    expected = modal_equations.respond(SPAN, loads, SENSORS, TIMES)
    on = np.sum(expected.contact_force > 0, axis=1)
    assert set(on) == {0, 1, 2, 3}
    assert_close(stream(loads).deflection, expected.deflection, 1e-8)


@pytest.fixture(scope="module")
def stream():
    """Simulate two masses and a force on the span."""
    case = case_of(SPAN, [Load(0.3, 1.0), Load(0.3, 1.0, kind="force"), Load(0.3, 1.0)])
    plan = plan_of(case, slots=3)

    def run(loads: list[Load]):
        changed = eqx.tree_at(lambda c: c.loads, case, tuple(load_of(load) for load in loads))
        return jb.simulate(changed, jnp.asarray(TIMES), plan)

    return run


def test_a_table_of_positions_gives_the_motion_it_samples(one_mass):
    """A parabola is a spline, so a braking motion may be given as a table."""
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


# Closed forms and limits


@pytest.fixture(scope="module")
def one_force():
    """Simulate a force of 3 N on the undamped span, over twice the time of its crossing."""
    case = case_of(UNDAMPED, [Load(3.0 / GRAVITY, 1.0, kind="force")])
    plan = plan_of(case)

    def run(speed):
        times = np.linspace(0.0, 2 * SPAN.length / speed, 101)
        return jb.simulate(jb.replace(case, {"loads.0.speed": speed}), jnp.asarray(times), plan)

    return run


UNDAMPED = dataclasses.replace(SPAN, damping_ratio=0.0)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 1.0, 1.0 + 1e-9, 2.0, 3.7])
def test_a_moving_force_has_its_closed_form_at_every_speed(one_force, ratio):
    record = one_force(ratio * critical_speed(UNDAMPED))
    q, u = moving_force(UNDAMPED, 3.0, ratio * critical_speed(UNDAMPED), np.asarray(record.times))
    assert_close(record.deflection, q @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)
    assert_close(record.velocity, u @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)


@pytest.mark.parametrize(("mode", "order"), [(1, 1), (2, 1), (3, -1)])
def test_a_force_at_a_cancellation_speed_leaves_its_mode_at_rest(one_force, mode, order):
    record = one_force(cancellation_speed(UNDAMPED, mode, order))
    q = np.abs(record.coordinates[:, mode - 1])
    assert q[51:].max() < 1e-10 * q.max()


def test_a_light_mass_of_the_same_weight_tends_to_the_force(one_mass):
    """Linearly: the contact force departs from the weight by the inertia."""
    load = Load(0.3, 2.0)
    force = modal_equations.respond(
        SPAN, [dataclasses.replace(load, kind="force")], SENSORS, TIMES
    ).deflection
    errors = []
    for share in (1e-3, 1e-4):
        light = dataclasses.replace(load, mass=share * load.mass)
        record = one_mass(light, **{"run.gravity": GRAVITY / share})
        errors.append(np.max(np.abs(record.deflection - force)) / np.max(np.abs(force)))
    assert_allclose(errors[0] / errors[1], 10.0, rtol=0.01)
    assert errors[1] < 1e-4


def test_a_slow_mass_bends_the_beam_statically(one_mass):
    """Damping delays the beam in proportion to the speed, inertia to its square."""
    places = np.linspace(0.3, 0.45, 101)  # put on the middle, and calm towards the end of these
    first, second, third = (
        one_mass(
            Load(0.3, v, entry_time=-0.3 / v),
            times=(places - 0.3) / v,
            **{"beam.damping_ratio": 0.2},
        ).deflection
        for v in (0.08, 0.04, 0.02)
    )
    extrapolated = (first - 6 * second + 8 * third) / 3
    weight = 0.3 * GRAVITY
    shapes = SPAN.shapes(np.array(SENSORS)) / SPAN.frequencies**2
    static = -weight * SPAN.shapes(places) @ shapes.T
    calm = slice(85, None)
    assert_close(extrapolated[calm], static[calm], 1e-7)
    exact = [influence_line(0.6, 11.68, "pinned-pinned", x, places[calm]) for x in SENSORS]
    assert_close(extrapolated[calm], weight * np.array(exact).T, 5e-3)  # four modes of all


# What a record promises


def test_modal_energy_changes_by_the_work_of_the_contact_force_and_by_damping():
    """At Gauss points of the time on the beam, which are given, uneven times."""
    span = dataclasses.replace(SPAN, modes=2)
    load, pieces = Load(0.4, 2.0), np.linspace(0.0, 0.3, 31)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = np.diff(pieces) / 2
    inner = (pieces[:-1] + half)[:, None] + half[:, None] * nodes
    times = np.concatenate([[0.0], inner.ravel(), [0.3 - 1e-12]])
    quadrature = np.concatenate([[0.0], np.outer(half, weights).ravel(), [0.0]])
    case = case_of(span, [load])
    record = jb.simulate(case, jnp.asarray(times), plan_of(case, substeps=1, even=False))
    expected = modal_equations.respond(span, [load], SENSORS, times)
    assert_close(record.deflection, expected.deflection, 1e-9)

    q, u = np.asarray(record.coordinates), np.asarray(record.rates)
    energy = np.sum(u**2 + span.frequencies**2 * q**2, axis=1) / 2
    under = np.sum(u * record.modes.shapes(record.load_position[:, 0]), axis=1)
    work = quadrature @ (-record.contact_force[:, 0] * under)
    dissipated = quadrature @ np.sum(2 * span.damping_ratio * span.frequencies * u**2, axis=1)
    assert_allclose(energy[-1] + dissipated, work, rtol=1e-9)
    assert dissipated > 0.01 * work


def test_the_contact_force_is_weight_and_inertia_along_the_path(one_mass):
    load = Load(0.4, 2.0, 0.05, deceleration=1.0)
    record = one_mass(load)
    on = np.flatnonzero(np.isfinite(record.load_position[:, 0]))
    x, speed, acceleration = np.array([load.motion(t, 0.6, False) for t in TIMES[on]]).T
    assert_allclose(record.load_position[on, 0], x, rtol=1e-12, atol=1e-15)
    q, u, a = (getattr(record, name)[on] for name in ("coordinates", "rates", "accelerations"))
    shape, slope, curvature = (record.modes.shapes(x, order) for order in range(3))
    path = np.sum(shape * a + 2 * speed[:, None] * slope * u, axis=1)
    path += np.sum((speed**2)[:, None] * curvature * q + acceleration[:, None] * slope * q, axis=1)
    assert_close(record.contact_force[on, 0], 0.4 * (GRAVITY + path), 1e-11)
    off = np.isnan(record.load_position[:, 0])
    assert off.any() and np.all(record.contact_force[off] == 0)


def test_a_lost_contact_is_reported_once(one_mass):
    load = Load(0.6, 8.0)
    times = np.linspace(0.0, 0.2, 101)
    with pytest.warns(ContactLossWarning, match="load 0 loses contact") as caught:
        record = one_mass(load, times)
    assert len(caught) == 1
    fine = np.linspace(0.0, SPAN.length / load.speed, 20001)[:-1]
    force = modal_equations.respond(SPAN, [load], SENSORS, fine).contact_force[:, 0]
    first = fine[np.argmax(force < 0)]
    assert force.min() < -1.0
    # It is looked for at the nodes of the steps.
    step = 0.2 / 1200
    assert first - 1e-5 <= record.contact_lost_time[0] < first + step
    assert_allclose(record.contact_lost_position[0], 8.0 * record.contact_lost_time[0], rtol=1e-12)
    assert_allclose(record.lowest_contact_force[0], force.min(), rtol=0.01)
    assert f"t = {float(record.contact_lost_time[0]):.4g} s" in record.verdict


def test_a_kept_contact_gives_no_warning(one_mass):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record = one_mass(Load(0.1, 1.0))
    assert np.isnan(record.contact_lost_time[0]) and record.lowest_contact_force[0] > 0


@pytest.mark.parametrize("speed", [1.3, 4.0, 9.0])
def test_peaks_are_those_between_samples(one_mass, speed):
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


def test_samples_depend_neither_on_the_time_step_nor_on_the_sample_rate(one_mass):
    load = Load(0.3, 2.0, 0.013, deceleration=1.0)
    case = case_of(SPAN, [load])
    record = one_mass(load)
    plan = dataclasses.replace(plan_of(case, substeps=30), lead=5)  # back to the start
    other = jb.simulate(case, jnp.asarray(TIMES[10::2]), plan)
    assert_close(other.deflection, record.deflection[10::2], 1e-10)
    assert_close(other.contact_force, record.contact_force[10::2], 1e-9)
    assert_allclose(other.peak_deflection, record.peak_deflection, rtol=1e-9)


def test_the_integrator_converges_with_twice_the_order_of_its_nodes():
    """To the state of the modal equations, with the mass still on the beam."""
    span, load = dataclasses.replace(SPAN, modes=2), Load(0.5, 1.5)
    case = jb.replace(case_of(span, [load]), {"run.duration": 0.32})
    shape = static_shapes(case)

    @eqx.filter_jit
    def end(longest):
        assembled = modal_model(case, shape.layout, shape.coupled)
        grid = grid_by_step_length(case, assembled, longest)
        rigging = discrete_model(assembled, grid, None)
        return integrate_history(rigging, load_set(case), max_loads=1, steps=64)[1][-1, :, 0]

    counts = np.array([24, 32, 48, 64])
    expected = modal_equations.respond(span, [load], SENSORS, np.array([0.0, 0.32])).modal[1]
    ends = [np.abs(end(jnp.array(0.32 / n)))[0:4:2] for n in counts]
    errors = [np.max(np.abs(found - np.abs(expected))) / np.abs(expected).max() for found in ends]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert 11 < order < 13


# Bad times


@pytest.mark.parametrize(
    ("times", "complaint"),
    [
        ([0.0], "at least two"),
        ([0.0, 0.2, 0.1], "ascend"),
        ([0.0, np.nan], "finite"),
    ],
)
def test_faulty_times_are_refused(times, complaint):
    with pytest.raises(ValueError, match=complaint):
        jb.simulate(case_of(SPAN, [Load(0.3, 1.0)]), jnp.asarray(times))
