"""Contact forces at the ends of steps, beside those of a run with much shorter steps."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.integrator.discrete_model import GAUSS_NODES, discrete_model
from jaxbeam.integrator.integrate import _weights, integrate_history, step_inputs
from jaxbeam.integrator.load_path import END_FRACTIONS, end_forces, load_path
from jaxbeam.integrator.time_grid import grid_by_step_length
from jaxbeam.model.contact import contact_at
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import corrected_places, sensor_rows, static_correction

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
