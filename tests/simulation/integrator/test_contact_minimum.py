"""Contact forces at the ends of steps and within, the smallest and the first losses."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.contact import contact_at
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import corrected_places, sensor_rows, static_correction
from jaxbeam.simulation.integrator.discrete_model import GAUSS_NODES, discrete_model
from jaxbeam.simulation.integrator.integrate import _weights, integrate_history, step_inputs
from jaxbeam.simulation.integrator.load_path import END_FRACTIONS, end_forces, load_path
from jaxbeam.simulation.integrator.peaks import contact_minimum
from jaxbeam.simulation.integrator.time_grid import grid_by_step_length
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.oracles import modal_equations
from tests.oracles.crossing import Load

NODES = np.asarray(GAUSS_NODES)
START, LENGTH = np.array([0.0, 2.0]), np.array([2.0, 1.0])
SPAN = modal_equations.Span(2.0, 50.0, 1.5, modes=4, damping_ratio=0.01)


def minimum(force, lowest=np.inf):
    """Smallest value and first loss of a force that is a function of time, over both steps."""
    times = START[:, None] + LENGTH[:, None] * NODES
    found = contact_minimum(
        np.array([[lowest]]),
        np.array([[NEVER]]),
        -force(times)[..., None],
        np.ones((2, 1, 1), bool),
        START,
        LENGTH,
    )
    return float(found[0][0, 0]), float(found[1][0, 0])


@pytest.mark.parametrize(
    ("force", "lowest", "lost"),
    [
        (lambda t: 1.0 + (t - 1.37) ** 2, 1.0, NEVER),
        (lambda t: (t - 2.41) ** 2 - 0.0625, -0.0625, 2.16),
        (lambda t: 3.0 + 1e-13 - t, 0.0, NEVER),  # least at the end of the last step
        (lambda t: t - 0.1, -0.1, 0.0),  # at the start of the first
        (lambda t: (t - 1.1) ** 2 - 1e-6, -1e-6, 1.099),  # pulls between two fractions only
        (lambda t: (1.3 - t) * (t**4 + 1.0), -139.4, 1.3),  # not straight between fractions
    ],
)
def test_smallest_force_of_polynomials(force, lowest, lost):
    found, at = minimum(force)
    assert_allclose(found, lowest, rtol=1e-10, atol=1e-12)
    assert_allclose(at, lost, rtol=1e-9)


def test_a_graze_at_a_fraction_is_lost_nearby():
    """Newton's method goes astray from a top that hardly pulls: its start is kept."""
    assert_allclose(minimum(lambda t: (t - 1.0) ** 2 - 1e-6), (-1e-6, 0.999), rtol=1e-3)


def test_a_bound_skips_no_smaller_force():
    """Random polynomials: a smallest force so far changes nothing but what is above it."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        curve = np.polynomial.Polynomial(rng.normal(size=6))
        alone = minimum(curve)[0]
        assert minimum(curve, alone + 1e-9)[0] == alone
        assert minimum(curve, alone - 1e-9)[0] == alone - 1e-9


@settings(max_examples=30)
@given(
    hnp.arrays(float, (3, 2, 3, 2), elements=st.floats(-1, 1)),
    hnp.arrays(bool, (3, 2, 2)),
    st.booleans(),
)
def test_each_load_is_lost_in_the_first_step_with_a_pull(coefficients, on_beam, swapped):
    """Parabolas of two rows in three steps, by (step, row, power, run), for either of two loads."""
    start, length = np.array([0.0, 1.0, 3.0]), np.array([1.0, 2.0, 0.5])
    rows = np.eye(2, dtype=bool)[:, ::-1] if swapped else np.eye(2, dtype=bool)
    is_load = on_beam[:, :, :1] & rows  # step, row, load
    forces = np.einsum("srpb,np->srnb", coefficients, NODES[:, None] ** np.arange(3))
    given_before = np.full((2, 2), np.inf), np.full((2, 2), NEVER)
    arguments = *given_before, -forces.reshape(3, -1, 2), is_load, start, length
    found = contact_minimum(*arguments)
    fine = np.linspace(0.0, 1.0, 2001)
    curves = np.einsum("srpb,np->srnb", coefficients, fine[:, None] ** np.arange(3))
    for load in range(2):
        row = 1 - load if swapped else load
        here = is_load[:, row, load]
        values, times = curves[here, row], start[here, None] + length[here, None] * fine
        lowest = np.min(values, axis=(0, 1), initial=np.inf)
        assert_allclose(found[0][load], lowest, atol=1e-6)
        for run in range(2):
            pulls = times[values[..., run] < -1e-6]
            if pulls.size:
                assert found[1][load, run] <= pulls.min() + 1e-9
            earlier = times[values[..., run] < 1e-6]
            assert found[1][load, run] >= np.min(earlier, initial=NEVER) - 2e-3
    for traced, known in zip(jax.jit(contact_minimum)(*arguments), found, strict=True):
        assert_allclose(traced, known, rtol=1e-9, atol=1e-9)


def test_without_loads_nothing_is_found():
    none = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((2, 0, 3)), np.zeros((2, 0, 0), bool)
    for found in (contact_minimum, jax.jit(contact_minimum)):
        assert [part.shape for part in found(*none, START, LENGTH)] == [(0, 3), (0, 3)]


@pytest.mark.parametrize(("mass", "speed"), [(3.0, 15.0), (3.0, -30.0)])
def test_few_samples_give_the_smallest_force_of_scipy(mass, speed):
    """Steps are long, and forces change much within them."""
    load = Load(mass, speed)
    end = load.time_at(SPAN.length)
    fine = np.linspace(0.0, end, 4001)[:-1]
    force = modal_equations.respond(SPAN, [load], [1.0], fine).contact_force[:, 0]
    case = jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.01, modes=4),
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=mass, speed=speed)],
        run=jb.Run(end, sample_rate=5 / end),
    )
    with pytest.warns(ContactLossWarning):
        record = jb.simulate(case)
    size = np.abs(force).max()
    assert_allclose(record.lowest_contact_force[0], force.min(), atol=1e-5 * size)
    loss = np.argmax(force < 0)
    lost = np.interp(0.0, -force[loss - 1 : loss + 1], fine[loss - 1 : loss + 1])
    assert_allclose(record.contact_lost_time[0], lost, atol=1e-6 * end)


BEAM = jb.Beam(1.2, 11.68, 0.535, 0.02, modes=3)
RUN = jb.Run(0.5, sample_rate=100.0)
SENSORS = [jb.Sensor(0.45, "moment")]
CASES = {
    "two masses, one that brakes": jb.Case(
        BEAM,
        sensors=SENSORS,
        loads=[
            jb.MovingMass(mass=0.3, speed=4.0, deceleration=3.0),
            jb.MovingMass(mass=0.2, speed=-3.0, entry_time=0.1),
        ],
        run=RUN,
    ),
    "surface": jb.Case(
        BEAM,
        sensors=SENSORS,
        loads=[jb.MovingMass(mass=0.3, speed=4.0)],
        profile=jb.profiles.SineProfile(amplitude=1e-4, wavelength=0.7),
        run=RUN,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_forces_at_ends_follow_from_the_states(name):
    """Far closer than extrapolated ones; the contact law at single instants is another program."""
    case = CASES[name]
    model, loads = modal_model(case), load_set(case)
    outputs = sensor_rows(model, case, case.sensors)
    correction = static_correction(model, case, case.sensors, outputs)
    places = corrected_places(case, model, case.sensors)

    def run(refinement):
        grid = grid_by_step_length(case, model, np.asarray(0.01), 0, places, refinement)
        discrete = discrete_model(model, grid, None, None, outputs, correction)
        count = int(grid.step_count)
        _, states, *_ = integrate_history(discrete, loads, max_loads=loads.wheel_count, steps=count)
        return discrete, load_path(discrete, loads, loads.wheel_count, np.arange(count)), states

    discrete, path, states = run(1)
    steps = step_inputs(discrete, loads, path)
    both = states[:-1], states[-1]
    at_nodes = _forces_at_nodes(model, loads, path, states, steps)
    weight = _weights(loads, path, END_FRACTIONS)
    found = end_forces(path.ends, steps.inertia, weight, *both, at_nodes)
    extrapolated = end_forces(None, steps.inertia, weight, *both, at_nodes)
    _, fine, fine_states = run(8)
    here = fine.length > 0
    exact = contact_at(model, loads, fine.start[here], fine_states[:-1][here]).force[..., 0]
    errors = []
    for forces in (found, extrapolated):
        starts = forces.reshape(len(path.start), -1, 2, 1)[:, :, 0, 0]
        worst = 0.0
        for i in np.flatnonzero(path.length > 0):
            at = np.flatnonzero(np.abs(fine.start[here] - path.start[i]) < 1e-12)[-1]
            on = path.on_beam[i]
            worst = max(worst, np.abs(starts[i][on] - exact[at][path.loads[i][on]]).max(initial=0))
        errors.append(worst)
    assert errors[0] < 1e-7 * np.abs(exact).max()
    assert errors[0] < 1e-3 * errors[1]


def _forces_at_nodes(model, loads, path, states, steps):
    """Forces (step, row, batch) at the Gauss nodes of a run, from the step's own equations."""
    right = steps.weight + steps.inertia * (steps.matrices.contact_response @ states[:-1])
    rows = right.shape[1]
    system = np.eye(rows) + steps.inertia * steps.matrices.contact_compliance
    forces = -np.linalg.solve(system, right)
    assert rows == loads.wheel_count * len(GAUSS_NODES)
    assert_allclose(forces[~np.repeat(path.on_beam, len(GAUSS_NODES), axis=1)], 0.0)
    return forces
