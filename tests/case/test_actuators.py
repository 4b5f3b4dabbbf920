"""Actuators: limits of commands, moment of a patch, electromechanics of a coil."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.case.case import addresses, replace
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import mesh_layout

# Smart Material M8557-P1 on rig B of the thesis: sections 2.4.1 and 2.4.2.
MATERIAL = {
    "d33": 460e-12,
    "modulus": 30.336e9,
    "electrode_spacing": 407.18e-6,
    "beam_height": 2.83e-3,
    "patch_height": 0.3e-3,
    "patch_width": 57e-3,
}
V4 = jb.Electrodynamic(0.5, 0.82, 5e-5, 4.2, mass=0.02, stiffness=9700.0, damping=0.55)  # table 2.3


def test_moment_per_volt_from_material():
    patch = jb.Patch(0.2575, 0.3425, correction=0.32, amplifier_gain=200.0, **MATERIAL)
    assert_allclose(patch.moment_constant, 8.2924e-4, rtol=1e-5)
    direct = jb.Patch(0.2575, 0.3425, patch.moment_constant, correction=0.32, amplifier_gain=200.0)
    assert_allclose(patch.attachment().static_gain, direct.attachment().static_gain, rtol=1e-15)
    assert_allclose(patch.attachment().static_gain, 8.2924e-4 * 0.32 * 200, rtol=1e-5)


def test_material_numbers_have_addresses():
    case = jb.Case(jb.Beam(0.6, 13.211, 0.812), actuators=[jb.Patch(0.2575, 0.3425, **MATERIAL)])
    found = addresses(case)
    for name, value in MATERIAL.items():
        assert_allclose(found[f"actuators.0.{name}"], value)
    changed = replace(case, {"actuators.0.d33": 230e-12})
    assert_allclose(changed.actuators[0].moment_constant, case.actuators[0].moment_constant / 2)


@pytest.mark.parametrize(
    ("given", "gain", "expected"),
    [
        (None, 1.0, [-500.0, 1500.0]),
        (None, 200.0, [-2.5, 7.5]),
        ([-1.25, 7.0], 200.0, [-1.25, 7.0]),
        ([-10.0, 5.0], 200.0, [-2.5, 5.0]),
        ([-1.0, 10.0], 200.0, [-1.0, 7.5]),
    ],
)
def test_command_limits_of_a_patch_include_depolarisation(given, gain, expected):
    patch = jb.Patch(
        start=0.2, end=0.3, moment_per_volt=1e-3, amplifier_gain=gain, limits=given, rate_limit=50.0
    )
    assert_allclose(patch.command_limits(), expected)
    assert patch.command_rate_limit() == 50.0


def test_command_limits_of_other_actuators():
    limited = [jb.PointForce(position=0.1, limits=[-1, 2]), jb.Shaker(position=0.1, limits=[-1, 2])]
    for actuator in limited:
        assert_allclose(actuator.command_limits(), [-1, 2])
    for actuator in (jb.PointForce(0.1), jb.Shaker(0.1), V4, jb.SpringDamper(0.1)):
        assert actuator.command_limits() is None
        assert actuator.command_rate_limit() is None
    assert jb.Patch(0.1, 0.2, 1e-3).command_rate_limit() is None


@pytest.mark.parametrize("back_emf", [None, 4.2, 3.0])
def test_power_balance_of_a_coil(back_emf):
    """u I = R I^2 + damping + d/dt of the stored energy for any state, if K_v = K_f."""
    shaker = jb.Electrodynamic(0.5, 0.82, 5e-5, 4.2, back_emf, 0.02, 9700.0, 0.55)
    case = jb.Case(jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03), actuators=[shaker])
    model = eqx.filter_jit(modal_model)(case, mesh_layout(case))
    matrix = np.asarray(model.state_matrix[0])
    state = np.random.default_rng(1).standard_normal(7)
    volts, current, rates = 3.0, state[6], state[1:6:2]
    change = matrix @ state + np.asarray(model.command_matrix)[:, 0] * volts
    displacements, stiffness = state[0:6:2], np.asarray(model.stiffness())
    stored_power = (
        rates @ change[1:6:2] + displacements @ stiffness @ rates + 5e-5 * current * change[6]
    )
    dissipated = -rates @ matrix[1:6:2, 1:6:2] @ rates + 0.82 * current**2
    assert dissipated > 0
    mismatch_power = ((4.2 - (4.2 if back_emf is None else back_emf)) * current) * float(
        model.displacement_map[0] @ rates
    )
    assert_allclose(volts * current + mismatch_power, stored_power + dissipated, rtol=1e-10)


def test_crossing_mass_on_a_beam_with_a_shorted_coil():
    """Against the coupled electromechanical equations of sine modes, integrated by scipy."""
    beam = {"length": 0.6, "rigidity": 11.68, "density": 0.535, "ratio": 0.03}
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03),
        actuators=[V4],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(0.5, 2.0)],
        run=jb.Run(duration=0.5, sample_rate=200.0),
    )
    wave = np.arange(1, 4) * np.pi / beam["length"]
    omega = wave**2 * np.sqrt(beam["rigidity"] / beam["density"])
    size = np.sqrt(2 / (beam["density"] * beam["length"]))
    shape_at_coil = size * np.sin(wave * 0.5)

    def rates(t, y, on):
        q, u, current = y[:3], y[3:6], y[6]
        mass = np.eye(3) + 0.02 * np.outer(shape_at_coil, shape_at_coil)
        force = -2 * 0.03 * omega * u - omega**2 * q
        force += shape_at_coil * (
            4.2 * current - 9700 * shape_at_coil @ q - 0.55 * shape_at_coil @ u
        )
        if on:
            x, speed = 2.0 * t, 2.0
            shape = size * np.sin(wave * x)
            slope, curvature = size * wave * np.cos(wave * x), -size * wave**2 * np.sin(wave * x)
            mass += 0.5 * np.outer(shape, shape)
            force -= shape * 0.5 * (9.81 + 2 * speed * slope @ u + speed**2 * curvature @ q)
        coil = (-0.82 * current - 4.2 * shape_at_coil @ u) / 5e-5
        return np.concatenate([u, np.linalg.solve(mass, force), [coil]])

    options = {"method": "Radau", "rtol": 1e-9, "atol": 1e-12}
    record, history = jb.simulate(case), []
    times = np.asarray(record.times)
    start = np.zeros(7)
    for on, first, last in ((True, 0.0, 0.3), (False, 0.3, 0.5)):
        here = times[(times >= first) & ((times < last) if on else (times <= last))]
        found = solve_ivp(rates, (first, last), start, t_eval=[*here, last] if on else here,
                          args=(on,), **options)  # fmt: skip
        history.append(found.y[:3, : here.size].T)
        start = found.y[:, -1]
    expected = np.concatenate(history) @ (size * np.sin(wave * 0.3))
    assert_allclose(record.deflection[:, 0], expected, atol=2e-6 * np.abs(expected).max())


def test_static_gains():
    assert_allclose(V4.attachment().static_gain, 4.2 / 0.82, rtol=1e-15)
    assert_allclose(jb.Shaker(0.1, force_per_volt=4.6).attachment().static_gain, 4.6, rtol=1e-15)
    assert jnp.ndim(jb.PointForce(0.1).attachment().static_gain) == 0
