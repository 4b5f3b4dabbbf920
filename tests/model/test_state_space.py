"""State space: against independent equations, scipy, python-control and simulations."""

import builtins

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.signal
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import state_space
from tests.differences import central
from tests.oracles.crossing import GRAVITY, Load
from tests.oracles.modal_equations import Span, _System

SPAN = Span(0.6, 11.68, 0.535, 3, 0.03)
BEAM = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3)
SENSORS = [
    jb.Sensor(0.25),
    jb.Sensor(0.35, "velocity"),
    jb.Sensor(0.2, "acceleration"),
    jb.Sensor(0.3, "strain", fibre_distance=0.0015),
    jb.Sensor(0.1, "slope"),
]
CASE = jb.Case(
    BEAM,
    actuators=[
        jb.Shaker(0.5, stiffness=3500.0, damping=80.0),
        jb.Patch(0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0),
    ],
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=0.509, speed=2.0), jb.MovingForce(force=2.0, speed=3.0)],
    run=jb.Run(0.6, sample_rate=1000.0, gravity=GRAVITY),
)


@pytest.fixture(scope="module")
def system():
    return state_space(CASE)


@pytest.fixture(scope="module")
def record():
    return jb.simulate(CASE)


@pytest.fixture(scope="module")
def outputs(record):
    """Readings, the strain among them as the sum of the modes, without static correction."""
    found = np.array(record.measured)
    found[:, 3] = -0.0015 * np.asarray(record.coordinates) @ np.asarray(record.modes.shapes(0.3, 2))
    return found


def in_sines(states):
    """Mass-normalised states of the oracle as amplitudes of sin(n pi x / L)."""
    return states * np.sqrt(2 / (0.535 * 0.6))


@pytest.mark.parametrize("t", [0.05, 0.21, 0.5])
def test_matrices_are_those_of_the_modal_equations(t):
    """Columns of A(t) from unit states of the oracle, B_f(t) W from its state at rest."""
    kinds = ("mass", 0.509, 2.0, 1.5), ("force", 0.3, 3.0, 0.0), ("mass", 0.2, -2.5, 0.0)
    loads, case_loads = [], []
    for kind, mass, speed, braking in kinds:
        make = {"mass": jb.MovingMass, "force": jb.MovingForce}[kind]
        case_loads.append(make(mass=mass, speed=speed, deceleration=braking))
        loads.append(Load(mass, speed, 0.0, braking, kind))
    case = jb.Case(BEAM, loads=case_loads, run=jb.Run(1.0, gravity=GRAVITY))
    oracle = _System(SPAN, loads, t)
    rest = oracle.rate(t, np.zeros(6))
    expected = np.array([oracle.rate(t, unit) - rest for unit in np.eye(6)]).T
    system = state_space(case)
    size = np.max(np.abs(expected))
    assert_allclose(eqx.filter_jit(system.A)(t), expected, rtol=0, atol=1e-10 * size)
    rate_by_weights = system.B_f(t) @ system.weights
    assert_allclose(rate_by_weights, rest, rtol=1e-9, atol=1e-9)
    sines = state_space(case, "sine")
    assert_allclose(sines.A(t), expected, rtol=0, atol=1e-10 * size)  # all scaled alike
    assert_allclose(sines.B_f(t) @ sines.weights, in_sines(rest), rtol=1e-9, atol=1e-9)


def test_integrated_state_space_equals_the_simulation(system, record, outputs):
    """z' = A(t) z + B_f(t) W, eq. (2.36) of the thesis, by DOP853, against `simulate`."""
    rate = jax.jit(lambda t, z: system.A(t) @ z + system.B_f(t) @ system.weights)
    times = np.asarray(record.times)
    states, start = [np.zeros((1, 7))], 0.0
    for end in (0.2, 0.3, 0.6):  # the force leaves, the mass leaves
        inner = times[(times > start + 1e-9) & (times < end + 1e-9)]
        state = states[-1][-1]
        # Just before the end: at it the load is gone.
        found = solve_ivp(
            lambda t, z, end=end: np.asarray(rate(min(t, end - 1e-12), z)), (start, inner[-1]),
            state, "DOP853", inner, rtol=1e-12, atol=1e-15,
        )  # fmt: skip
        states.append(found.y.T)
        start = end
    states = np.concatenate(states)
    observe = jax.jit(jax.vmap(lambda t, z: system.at(t).C @ z + _direct(system, t)))
    expected = np.asarray(observe(record.times, jnp.asarray(states)))
    for i in range(len(SENSORS)):
        size = np.max(np.abs(expected[:, i]))
        assert_allclose(outputs[:, i], expected[:, i], rtol=0, atol=1e-8 * size)


def _direct(system, t):
    """Direct feedthrough of the weights to the outputs."""
    return system.at(t).D[:, len(system.case.actuators) :] @ system.weights


def test_frequency_response_is_that_of_the_modal_impedances():
    """Force and moment to deflection, from impedances computed here."""
    case = jb.Case(
        BEAM,
        actuators=[jb.PointForce(0.5), *CASE.actuators],
        sensors=[jb.Sensor(0.25), jb.Sensor(0.25, "velocity")],
    )
    model = state_space(case).unloaded.to_control()
    omega = 2 * np.pi * np.array([0.1, 10.0, 27.5, 90.0, 400.0])
    found = control.frequency_response(model, omega).frdata  # output, input, frequency
    s = 1j * omega[:, None, None]
    phi = SPAN.shapes(0.5)
    impedance = np.eye(3) * (s**2 + 2 * 0.03 * SPAN.frequencies * s + SPAN.frequencies**2)
    impedance = impedance + (3500.0 + 80.0 * s) * np.outer(phi, phi)
    lag = 4.6e4 / (s[:, 0, 0] + 1e4)
    moment = 8.292e-4 * 0.32 * 200 * (SPAN.shapes(0.2575, 1) - SPAN.shapes(0.3425, 1))
    forces = np.array([phi * np.ones((5, 1)), phi * lag[:, None], moment * np.ones((5, 1))])
    expected = [
        np.linalg.solve(impedance, f[..., None])[..., 0] @ SPAN.shapes(0.25) for f in forces
    ]
    assert_allclose(found[0], expected, rtol=1e-9)
    assert_allclose(found[1], expected * s[:, 0, 0], rtol=1e-9)


def test_the_augmented_system_is_that_of_equation_5_8(system):
    frozen, augmented = system.at(0.1), system.augmented(0.1)
    assert augmented.A.shape == (9, 9) and augmented.B.shape == (9, 2)
    assert_array_equal(augmented.A[:7, :7], frozen.A)
    assert_array_equal(augmented.A[:7, 7:], system.B_f(0.1))
    assert not np.any(augmented.A[7:]) and not np.any(augmented.B[7:])
    assert [s.name for s in augmented.states[-2:]] == ["load_0", "load_1"]
    assert_allclose(system.weights, [0.509 * GRAVITY, 2.0])
    z = jnp.linspace(-1.0, 1.0, 7)
    inputs = jnp.append(jnp.zeros(2), system.weights)
    found = augmented.C @ jnp.append(z, system.weights)
    assert_allclose(found, frozen.C @ z + frozen.D @ inputs, rtol=1e-12)


def test_masses_on_the_beam_reduce_the_input_matrix_of_a_patch(system):
    """B(t) of a patch is smaller with a mass on it; that of the lagging shaker is constant."""
    free, loaded = system.unloaded.B, system.B(0.15)
    assert_array_equal(loaded[:, 0], free[:, 0])
    shape = SPAN.shapes(0.3)
    inverse = np.linalg.inv(np.eye(3) + 0.509 * np.outer(shape, shape))
    assert_allclose(loaded[3:6, 1], inverse @ free[3:6, 1], rtol=1e-9, atol=1e-13)


def test_static_responses_are_gains_of_python_control(system):
    """-C A^-1 B + D is what a constant input ends at."""
    unloaded = system.unloaded
    found = unloaded.static_response(slice(None)) @ unloaded.B + unloaded.D
    matrices = (np.asarray(getattr(unloaded, name)) for name in "ABCD")
    expected = control.ss(*matrices).dcgain()
    # Velocities and accelerations end at 0, of 1e-3 m times powers of 600 rad/s but for rounding.
    assert_allclose(found, expected, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("period", [1e-4, 1e-3, 0.02])
def test_discretisation_is_that_of_scipy(system, period):
    for continuous in (system.unloaded, system.augmented(0.1)):
        found = continuous.discretize(period)
        parts = [np.asarray(getattr(continuous, name)) for name in "ABCD"]
        expected = scipy.signal.cont2discrete(parts, period, "zoh")
        # In states of like size, or rounding of the large ones would hide errors of the small.
        scale = np.append(np.append(SPAN.frequencies, np.ones(3)), np.ones(len(parts[0]) - 6))
        for name, theirs in zip("AB", expected, strict=False):
            ours, theirs = scale[:, None] * getattr(found, name), scale[:, None] * theirs
            if name == "A":
                ours, theirs = ours / scale, theirs / scale
            assert_allclose(ours, theirs, rtol=0, atol=1e-10 * np.max(np.abs(theirs)))
        assert_array_equal(found.C, continuous.C)
        assert float(found.period) == period and found.to_control().dt == period
    with pytest.raises(ValueError, match="discrete time already"):
        found.discretize(period)


def test_signals_are_named_with_units(system):
    assert [s.name for s in system.states[:4]] == ["q_1", "q_2", "q_3", "q_1_rate"]
    assert [s.unit for s in system.states[2:4]] == ["m kg^0.5", "m kg^0.5/s"]
    model = system.at(0.1).to_control()
    assert model.input_labels == ["command_0", "command_1", "load_0", "load_1"]
    assert [s.unit for s in system.at(0.1).inputs] == ["V", "V", "N", "N"]
    assert model.output_labels[:2] == ["sensor_0_deflection", "sensor_1_velocity"]
    assert state_space(CASE, "sine").states[0] == ("a_1", "m")


def test_states_of_vehicles_and_absorbers_have_names_and_units():
    """By the number of their load, of the vehicle in a row, and of the absorber."""
    wagon = jb.vehicles.Wagon(
        body_mass=1.0,
        body_inertia=1.0,
        bogie_mass=0.2,
        bogie_inertia=0.1,
        wheelset_mass=0.1,
        primary_stiffness=900.0,
        primary_damping=1.0,
        secondary_stiffness=300.0,
        secondary_damping=1.0,
        bogie_distance=0.3,
        wheelset_distance=0.1,
        count=2,
        spacing=0.6,
        speed=1.0,
    )
    absorbers = [jb.Absorber(x, mass=0.01, frequency=20.0, damping_ratio=0.1) for x in (0.2, 0.4)]
    loads = [jb.MovingForce(force=1.0, speed=1.0), wagon, jb.Oscillator(0.1, 400.0, 0.1, speed=1.0)]
    case = jb.Case(BEAM, loads=loads, absorbers=absorbers, run=jb.Run(1.0))
    system = state_space(case).at(0.1)
    parts = "body", "front_bogie", "rear_bogie"
    own = [f"{part}{way}" for part in parts for way in ("", "_pitch")]
    groups = [[f"load_1_vehicle_{i}_{name}" for name in own] for i in (1, 2)]
    groups += [["load_2_body"], ["absorber_0_body"], ["absorber_1_body"]]
    names = [f"{name}{rate}" for group in groups for rate in ("", "_rate") for name in group]
    units = ["rad" if "pitch" in name else "m" for name in names]
    units = [f"{u}/s" if n.endswith("rate") else u for n, u in zip(names, units, strict=True)]
    assert [tuple(s) for s in system.states[6:]] == list(zip(names, units, strict=True))
    at = {signal.name: i for i, signal in enumerate(system.states)}
    for name in (name for group in groups for name in group):
        assert_array_equal(np.flatnonzero(system.A[at[name]]), at[f"{name}_rate"])
    # Heights of the body of the oscillator and of absorbers: on springs with their own frequency.
    for name, stiffness in (("load_2_body", 400.0 / 0.1), ("absorber_1_body", (40 * np.pi) ** 2)):
        assert_allclose(-system.A[at[f"{name}_rate"], at[name]], stiffness, rtol=1e-12)


def test_mat_file_has_matrices_names_and_units(system, tmp_path):
    path = tmp_path / "plant.mat"
    frozen = system.at(0.1)
    frozen.to_mat(path)
    content = scipy.io.loadmat(path, squeeze_me=True)
    for name in "ABCD":
        assert_array_equal(content[name], getattr(frozen, name))
    assert list(content["inputs"]) == ["command_0", "command_1", "load_0", "load_1"]
    assert content["states_units"][0] == "m kg^0.5" and content["period"] == 0
    with pytest.raises(FileExistsError, match="exists already"):
        frozen.discretize(0.01).to_mat(path)
    frozen.discretize(0.01).to_mat(path, overwrite=True)
    assert scipy.io.loadmat(path)["period"] == 0.01


def test_without_python_control_the_error_names_the_package_to_install(system, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "control":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'jaxbeam\[control\]'"):
        system.unloaded.to_control()


def test_sine_amplitudes_are_refused_where_modes_are_no_sines():
    spans = jb.Case(BEAM, supports=[jb.Support(0.3)])
    with pytest.raises(ValueError, match="not sin"):
        state_space(spans, "sine")
    with pytest.raises(ValueError, match="coordinates may be 'modal' or 'sine', not 'nodal'"):
        state_space(CASE, "nodal")


def test_derivatives_by_mass_speed_and_rigidity():
    layout = mesh_layout(CASE)

    def discrete(factors):
        names = ["loads.0.mass", "loads.0.speed", "beam.flexural_rigidity"]
        sizes = jnp.array([0.5, 2.0, 12.0])
        case = jb.replace(CASE, dict(zip(names, factors * sizes, strict=True)))
        found = state_space(case, layout=layout).augmented(0.1).discretize(0.01)
        scale = jnp.array([200.0, 800.0, 1800.0, 1, 1, 1, 1, 1, 1])
        return (found.A * scale[:, None] / scale).ravel()

    discrete = jax.jit(discrete)
    ones = jnp.ones(3)
    expected = central(discrete, ones, step=1e-3)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = derivative(discrete)(ones)
        assert_allclose(found, expected, rtol=0, atol=1e-8 * np.max(np.abs(expected)))


def test_rayleigh_damping_is_proportional_to_mass_and_stiffness():
    """Free decays of a pinned beam: s^2 + (a + b w^2) s + w^2 = 0 for each mode."""
    a, b = 3.0, 2e-4
    beam = jb.Beam(0.6, 11.68, 0.535, rayleigh_damping=[a, b], modes=3)
    w = (np.arange(1, 4) * np.pi / 0.6) ** 2 * np.sqrt(11.68 / 0.535)
    expected = np.concatenate([np.roots([1.0, a + b * each**2, each**2]) for each in w])
    plant = jb.state_space(jb.Case(beam, loads=[jb.MovingMass(mass=0.1, speed=1.0)])).unloaded
    found = np.linalg.eigvals(np.asarray(plant.A))
    assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-9)
