"""Forces that vary in time against scipy: travelling and in place; bad input."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.simulation.integration_plan import integration_plan
from tests.differences import central

LENGTH, RIGIDITY, MODES, DAMPING, SPEED = 2.0, 6.0, 3, 0.02, 0.8
TABLE = [0.3, 0.9, 1.4], [0.0, 1.0, -0.5]
BEAM = jb.Beam(
    length=LENGTH,
    flexural_rigidity=RIGIDITY,
    mass_per_length=1.0,
    damping_ratio=DAMPING,
    modes=MODES,
)
FORCE = jb.VaryingForce(
    force=2.0,
    frequencies=[1.3, 3.0],
    amplitudes=[0.7, 0.2],
    phases=[0.2, 1.0],
    force_times=TABLE[0],
    forces=TABLE[1],
)
PLACES = {"travelling": {"speed": np.asarray(SPEED)}, "in place": {"position": np.asarray(0.7)}}


def case_with(**changes) -> jb.Case:
    load = dataclasses.replace(FORCE, **changes)
    return jb.Case(BEAM, loads=[load], sensors=[jb.Sensor(1.0)], run=jb.Run(2.6, 100.0))


def force(t):
    waves = 0.7 * np.sin(2 * np.pi * 1.3 * t + 0.2) + 0.2 * np.sin(2 * np.pi * 3.0 * t + 1.0)
    return 2.0 + waves + np.interp(t, *TABLE)


@pytest.mark.parametrize("place", PLACES)
def test_response_is_that_of_scipy(place):
    record = jb.simulate(case_with(**PLACES[place]))
    n = np.arange(1, MODES + 1)
    frequencies = (n * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY)

    def rates(t, y, on_beam):
        x = SPEED * t if place == "travelling" else 0.7
        modal_force = -on_beam * force(t) * np.sin(n * np.pi * x / LENGTH) * 2 / LENGTH
        q, u = y[:MODES], y[MODES:]
        return np.append(u, modal_force - frequencies**2 * q - 2 * DAMPING * frequencies * u)

    times, state = np.asarray(record.times), np.zeros(2 * MODES)
    midspan = np.zeros(times.size)
    leaves = LENGTH / SPEED if place == "travelling" else np.inf
    ends = [0.0, *TABLE[0], min(leaves, 2.55), times[-1]]
    for start, end in itertools.pairwise(ends):
        inside = (times >= start) & (times <= end)
        solution = solve_ivp(
            rates,
            (start, end),
            state,
            "DOP853",
            t_eval=times[inside],
            args=(start < leaves,),
            dense_output=True,
            rtol=1e-12,
            atol=1e-14,
            max_step=0.02,
        )
        midspan[inside] = np.sin(n * np.pi / 2) @ solution.y[:MODES]
        state = solution.sol(end)
    assert_allclose(record.deflection[:, 0], midspan, atol=1e-9 * np.abs(midspan).max())
    on_beam = times < leaves
    assert_allclose(record.contact_force[on_beam, 0], force(times[on_beam]), rtol=1e-12)


def test_sweeps_and_gradients_reach_its_numbers():
    case, address = case_with(speed=np.asarray(SPEED)), "loads.0.amplitudes.0"
    swept = jb.sweep(case, {address: [0.5, 1.0]}, progress=False).peak_deflection.values[:, 0]
    records = [jb.simulate(jb.replace(case, {address: a})) for a in (0.5, 1.0)]
    assert_allclose(swept, [float(record.peak_deflection[0]) for record in records], rtol=1e-7)
    plan = integration_plan(case)

    def last(amplitude):
        changed = jb.replace(case, {address: amplitude.reshape(())})
        return jb.simulate(changed, plan=plan).deflection[-1, 0]

    point = np.array([0.7])
    assert_allclose(jax.jit(jax.grad(last))(point), central(last, point), rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 1.0, "amplitudes": [1.0]}, "loads.0.amplitudes"),
        ({"speed": 1.0, "forces": None}, "loads.0.forces is missing"),
        ({"speed": 1.0, "position": 0.5}, "both position and speed"),
        ({"position": 3.0}, "loads.0.position must lie on the beam"),
        ({}, "neither speed nor times"),
    ],
)
def test_bad_input_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        check_case(case_with(**changes))
