"""Frequency responses against the thesis's formulas, matrices of the states, finite elements."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.model.frequency_responses import (
    accelerance,
    common_pairs,
    frequency_response,
    mobility,
    receptance,
    resonances_and_antiresonances,
    shaker_channels,
)
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import poles, zeros
from jaxbeam.model.static_correction import residual_port_flexibility
from tests.differences import central
from tests.loop_as_oracle import as_oracle
from tests.oracles import finite_elements

V4 = jb.Electrodynamic(0.5, 0.82, 5e-5, 4.2, mass=0.02, stiffness=9700.0, damping=0.55)
RIG_A = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=4),
    actuators=[V4],
    sensors=[jb.Sensor(0.25), jb.Sensor(0.35, "velocity")],
)
HALF_KILOGRAM = [(0.3, 0.5)]
GENERAL = jb.Case(
    jb.Beam(1.3, 2.0, 0.7, damping_ratio=0.02, ends="clamped-free", modes=4),
    supports=[jb.Support(0.3, 500.0, 0.4, 3.0), jb.Support(0.91)],
    actuators=[
        jb.Patch(0.2, 0.45, 1e-3, 0.5, 200.0, added_mass=0.4, added_rigidity=1.0),
        jb.Shaker(0.7, 300.0, 2.0, force_per_volt=2.0),
        jb.Electrodynamic(0.55, 0.8, 5e-3, 4.2, 3.9, 0.02, 900.0, 0.5),
        jb.PointForce(1.2),
    ],
    sensors=[
        jb.Sensor(1.1),
        jb.Sensor(0.5, "velocity"),
        jb.Sensor(1.2, "acceleration"),
        jb.Sensor(0.3, "slope"),
        jb.Sensor(0.25, "strain", fibre_distance=0.002),
    ],
)
F = np.array([0.0, 0.7, 3.0, 11.0, 26.5, 84.0, 190.0, 900.0])


def formulas(frequencies, modes=4, ratio=0.03, masses=()):
    """I/U, F_c/U, F/F_c and F/U by eqs (2.26) to (2.34) with sine modes (frequency, 4)."""
    wave = np.arange(1, modes + 1) * np.pi / 0.6
    omega = wave**2 * np.sqrt(11.68 / 0.535)
    size = np.sqrt(2 / (0.535 * 0.6))
    shape = size * np.sin(wave * 0.5)
    responses = []
    for s in 2j * np.pi * np.asarray(frequencies):
        mass = np.eye(modes)
        for position, added in masses:
            mass += added * np.outer(np.sin(wave * position), np.sin(wave * position)) * size**2
        beam = mass * s**2 + np.diag(2 * ratio * omega * s + omega**2)
        mobility_beam = s * shape @ np.linalg.solve(beam, shape)
        mobility_shaker = s / (s**2 * 0.02 + s * 0.55 + 9700)
        coupled_mobility = mobility_beam / (1 + mobility_beam / mobility_shaker)
        impedance = 0.82 + s * 5e-5 + 4.2 * 4.2 * coupled_mobility
        transmitted = mobility_shaker / (mobility_shaker + mobility_beam)
        responses.append(
            [1 / impedance, 4.2 / impedance, transmitted, 4.2 / impedance * transmitted]
        )
    return np.array(responses)


def dips_and_peaks(frequencies, size):
    """Frequencies and heights of the dips and of the peaks of a curve, ((dip, 2), (peak, 2))."""
    inner = size[1:-1]
    dips = np.flatnonzero((inner < size[:-2]) & (inner < size[2:])) + 1
    peaks = np.flatnonzero((inner > size[:-2]) & (inner > size[2:])) + 1
    return [np.column_stack([frequencies[i], size[i]]) for i in (dips, peaks)]


# The electrodynamic shaker of section 2.2


@pytest.mark.parametrize("masses", [[], HALF_KILOGRAM, [(0.1, 0.2), (0.45, 0.7)]])
def test_responses_of_the_shaker_by_the_formulas_of_the_thesis(masses):
    found = frequency_response(RIG_A, F[1:], shaker_channels(0), masses)
    assert_allclose(found.values, formulas(F[1:], masses=masses), rtol=1e-9)
    assert [pair.unit for pair in found.pairs] == ["A/V", "N/V", "1", "N/V"]


def test_figures_2_15_and_2_18_without_a_mass():
    f = np.linspace(0.5, 400.0, 40001)
    found = frequency_response(RIG_A, f, shaker_channels(0))
    current, _, transmitted, force_per_volt = np.asarray(found.magnitude).T
    assert_allclose(force_per_volt[0], 2.38, atol=0.005)
    assert np.ptp(force_per_volt[f < 5]) < 0.1 * force_per_volt[0]
    dips, peaks = dips_and_peaks(f, force_per_volt)
    assert_allclose(dips[:, 0], [20.3, 81.3, 184.4, 330.1], atol=0.1)
    assert_allclose(peaks[0], [27.5, 10.2], atol=0.06)
    # Figs 2.17 and 2.18: impedance and transmitted force peak at one resonance.
    impedance = dips_and_peaks(f, 1 / current)[1][0]
    assert_allclose([impedance[0], dips_and_peaks(f, transmitted)[1][0, 0]], 26.65, atol=0.1)


def test_figure_2_16_with_half_a_kilogram_in_the_middle():
    f = np.linspace(0.5, 40.0, 8001)
    force_per_volt = np.asarray(
        frequency_response(RIG_A, f, shaker_channels(0)[3:], HALF_KILOGRAM).magnitude
    )[:, 0]
    dips, peaks = dips_and_peaks(f, force_per_volt)
    assert_allclose(peaks, [[13.1, 20.2]], atol=0.05)
    # The force drops at the natural frequency of the bare beam with the mass: finite elements.
    assert_allclose(dips[:, 0], loaded_frequency(), rtol=5e-3)
    undamped = replace(RIG_A, {"beam.damping_ratio": 0.0})
    force_per_volt = np.asarray(
        frequency_response(undamped, f, shaker_channels(0)[3:], HALF_KILOGRAM).magnitude
    )
    assert_allclose(dips_and_peaks(f, force_per_volt[:, 0])[1], [[13.05, 27.6]], atol=0.05)


def loaded_frequency() -> float:
    model = finite_elements.assemble(finite_elements.Beam(0.6, 11.68, 0.535), [0.3])
    row, free = model.shape(0.3), model.free
    mass = (model.mass + 0.5 * np.outer(row, row))[np.ix_(free, free)]
    values = np.linalg.eigvals(np.linalg.solve(mass, model.stiffness[np.ix_(free, free)]))
    return float(np.sqrt(values.real.min()) / (2 * np.pi))


def test_figure_2_19_the_first_order_shaker():
    case = jb.Case(RIG_A.beam, actuators=[jb.Shaker(0.5, 3500.0, 80.0)])
    f = np.array([1.0, 100.0, 1e4 / (2 * np.pi), 1e4])
    pair = ("actuators.0", "actuators.0.active_force")
    found = frequency_response(case, f, [pair]).of(*pair)
    assert_allclose(found, 4.6e4 / (2j * np.pi * f + 1e4), rtol=1e-9)
    assert_allclose(np.abs(found[2]), 4.6 / np.sqrt(2), rtol=1e-9)  # at 1591.5 Hz


def test_figure_2_20_a_beam_less_mobile_than_the_shaker():
    """The whole coil force is transmitted; voltage to force is a first-order lag, R / L."""
    stiff = jb.Case(jb.Beam(0.6, 1.022e5, 11.016, damping_ratio=0.03, modes=4), actuators=[V4])
    f = np.array([1.0, 10.0, 30.0, 100.0])
    *_, transmitted, force_per_volt = np.asarray(
        frequency_response(stiff, f, shaker_channels(0)).values
    ).T
    assert_allclose(transmitted, 1.0, atol=2e-3)
    assert_allclose(force_per_volt, 4.2 / (0.82 + 5e-5 * 2j * np.pi * f), rtol=5e-3)


def test_poles_and_zeros_of_the_shaker():
    """Zeros of the force are the poles of the bare beam; the coil adds one fast pole."""
    bare = jb.Case(RIG_A.beam)
    found = zeros(RIG_A, shaker_channels(0)[3])
    assert_allclose(found, poles(bare), rtol=1e-7)
    assert_allclose(
        zeros(RIG_A, shaker_channels(0)[3], HALF_KILOGRAM), poles(bare, HALF_KILOGRAM), rtol=1e-7
    )
    natural = (np.arange(1, 5) * np.pi / 0.6) ** 2 * np.sqrt(11.68 / 0.535)
    assert_allclose(np.abs(poles(bare)), np.repeat(natural, 2), rtol=1e-9)
    shaker_poles = poles(RIG_A)
    assert shaker_poles.shape == (9,)
    assert np.all(shaker_poles.real < 0)
    assert_allclose(shaker_poles[-1], -0.82 / 5e-5, rtol=0.05)


# Cases of all kinds


def test_responses_of_the_state_space():
    """Deflection, velocity, slope and strain are rows on the states; acceleration needs B too.

    C (i w - A)^-1 B + D; python-control with slycot rounds 1e-11 of the largest.
    """
    model = eqx.filter_jit(modal_model)(GENERAL, mesh_layout(GENERAL))
    A, B = np.asarray(model.state_matrix[0]), np.asarray(model.command_matrix)
    rows, direct = np.zeros((5, len(A))), np.zeros((5, 4))
    rows[0, 0:8:2] = model.shapes(1.1, (0,))[0]
    rows[1, 1:8:2] = model.shapes(0.5, (0,))[0]
    rows[2] = np.asarray(model.shapes(1.2, (0,))[0]) @ A[1:8:2]
    direct[2] = np.asarray(model.shapes(1.2, (0,))[0]) @ B[1:8:2]
    rows[3, 0:8:2] = model.shapes(0.3, (1,))[0]
    rows[4, 0:8:2] = -0.002 * np.asarray(model.shapes(0.25, (2,))[0])
    resolvents = 2j * np.pi * F[:, None, None] * np.eye(len(A)) - A
    expected = np.moveaxis(rows @ np.linalg.solve(resolvents, B + 0j) + direct, 0, -1)
    pairs = [(f"actuators.{i}", f"sensors.{j}") for i in range(4) for j in range(5)]
    found = frequency_response(GENERAL, F, pairs).values.reshape(F.size, 4, 5)
    scale = np.abs(expected).max(axis=-1)
    assert_allclose(
        np.moveaxis(found, 0, -1).swapaxes(0, 1) / scale[..., None],
        expected / scale[..., None],
        rtol=1e-8,
        atol=1e-11,
    )


def test_receptance_of_a_pinned_beam_in_closed_form():
    """Green's function of E I w'''' - rho A omega^2 w = delta(x - y): sines and sinh."""
    case = jb.Case(jb.Beam(0.6, 11.68, 0.535, modes=40))
    f, x, y = np.array([5.0, 33.0, 140.0]), np.array([0.1, 0.3]), np.array([0.3, 0.42, 0.5])
    k = ((2 * np.pi * f) ** 2 * 0.535 / 11.68)[:, None, None] ** 0.25
    low, high = np.minimum(x[:, None], y), 0.6 - np.maximum(x[:, None], y)
    sines = np.sin(k * low) * np.sin(k * high) / np.sin(k * 0.6)
    sinh = np.sinh(k * low) * np.sinh(k * high) / np.sinh(k * 0.6)
    expected = (sines - sinh) / (2 * 11.68 * k**3)
    found = receptance(case, f, x, y)
    truncation_error = 2 * 0.6**3 / (np.pi**4 * 11.68) * np.sum(1 / np.arange(41.0, 1000.0) ** 4)
    assert_allclose(found, expected, rtol=0, atol=truncation_error)
    s = 2j * np.pi * f[:, None, None]
    assert_allclose(mobility(case, f, x, y), s * found, rtol=1e-12)
    assert_allclose(accelerance(case, f, x, y), s**2 * found, rtol=1e-12)
    assert_allclose(mobility(case, f, 0.1, 0.3), s[:, 0, 0] * found[:, 0, 0], rtol=1e-12)


def test_finite_elements_with_patch_coil_and_stationary_masses():
    """The full dynamic stiffness, coil eliminated, against twenty-four modes."""
    patch = jb.Patch(0.1, 0.3, 1e-3, added_mass=0.3, added_rigidity=4.0)
    coil = jb.Electrodynamic(0.75, 0.8, 5e-3, 4.2, 3.9, 0.02, 900.0, 0.5)
    beam = jb.Beam(1.0, 12.0, 0.8, ends="clamped-pinned", modes=24)
    case = jb.Case(beam, [jb.Support(0.6, 2e4, 0.0, 5.0)], [patch, coil], [jb.Sensor(0.45)])
    model = finite_elements.assemble(as_oracle(case, elements=60), [0.4, 0.45, 0.75, 0.9])
    free, shape = model.free, model.shape(0.75)
    inertia = model.mass + 0.02 * np.outer(shape, shape)
    for position, mass in ((0.4, 0.3), (0.9, 0.1)):
        inertia += mass * np.outer(model.shape(position), model.shape(position))
    frequencies, expected = np.array([2.0, 17.0, 46.0, 120.0]), []
    for s in 2j * np.pi * frequencies:
        coupled = 900.0 + 0.5 * s + 4.2 * 3.9 * s / (0.8 + 5e-3 * s)
        matrix = s**2 * inertia + model.stiffness + coupled * np.outer(shape, shape)
        nodal_forces = np.array([1e-3 * model.patch_row(0.1, 0.3), shape * 4.2 / (0.8 + 5e-3 * s)])
        displacements = np.linalg.solve(matrix[np.ix_(free, free)], nodal_forces[:, free].T)
        expected.append(model.shape(0.45)[free] @ displacements)
    pairs = [("actuators.0", "sensors.0"), ("actuators.1", "deflection@0.45")]
    found = frequency_response(case, frequencies, pairs, [(0.4, 0.3), (0.9, 0.1)])
    assert [pair.unit for pair in found.pairs] == ["m/V", "m/V"]
    errors = np.abs(np.asarray(found.values) - expected)
    assert np.all(errors < 1e-3 * np.abs(expected).max(axis=0))
    # The residual of the neglected modes, large for a patch, hardly depends on the frequency.
    gain = case.actuators[0].attachment().static_gain
    residual = gain * float(residual_port_flexibility(case, 0.45)[0])
    corrected = np.asarray(found.values)[:, 0] + residual
    assert np.abs(corrected - np.array(expected)[:, 0]).max() < errors[:, 0].max() / 5


def test_responses_differentiate_inside_jit():
    names = ("beam.flexural_rigidity", "actuators.0.resistance", "sensors.0.position")
    layout, pairs = mesh_layout(RIG_A), common_pairs(RIG_A)
    point = np.array([11.68, 0.82, 0.25])

    @jax.jit
    def log_magnitudes(values):
        case = replace(RIG_A, dict(zip(names, values * point, strict=True)))
        response = frequency_response(case, [3.0, 25.0, 80.0], pairs, HALF_KILOGRAM, layout)
        return jnp.log(response.magnitude).ravel()

    ones = jnp.ones(3)
    expected = central(log_magnitudes, ones, 1e-3)
    assert_allclose(jax.jacrev(log_magnitudes)(ones), expected, rtol=1e-6, atol=1e-7)

    def magnitude(x):
        return jnp.abs(receptance(RIG_A, [25.0], x, 0.2, [(x, 0.5)], layout))[0]

    assert_allclose(
        jax.grad(magnitude)(0.3), central(lambda x: magnitude(x[0]), [0.3])[0], rtol=1e-6
    )


# The record


def test_the_dataset_has_labels_and_units(tmp_path):
    found = frequency_response(RIG_A, np.linspace(1, 40, 40))
    assert [str(pair) for pair in found.pairs] == [
        "actuators.0 -> sensors.0",
        "actuators.0 -> sensors.1",
        "actuators.0 -> actuators.0.current",
        "actuators.0 -> actuators.0.active_force",
        "actuators.0.active_force -> actuators.0.transmitted_force",
        "actuators.0 -> actuators.0.transmitted_force",
    ]
    assert [pair.unit for pair in found.pairs] == ["m/V", "(m/s)/V", "A/V", "N/V", "1", "N/V"]
    assert np.abs(np.diff(found.phase, axis=0)).max() < 180
    found.to_netcdf(tmp_path / "out.nc")
    with xarray.open_dataset(tmp_path / "out.nc", engine="scipy") as saved:
        values = saved["real"] + 1j * saved["imaginary"]
        assert_allclose(values, found.values, rtol=1e-15)
        assert_allclose(saved["magnitude"], found.magnitude)
        assert list(saved["unit"].values) == [pair.unit for pair in found.pairs]
    with pytest.raises(FileExistsError, match="out.nc exists already"):
        found.to_netcdf(tmp_path / "out.nc")
    with pytest.raises(ValueError, match="no response of sensors.1 to force@0.3; there are"):
        found.of("force@0.3", "sensors.1")


def test_peaks_and_dips_lie_between_the_frequencies():
    f = np.geomspace(5.0, 50.0, 200)
    response = frequency_response(RIG_A, f, shaker_channels(0)[3:])
    first, dip, peak = resonances_and_antiresonances(response, 0)
    assert [word for word, *_ in (first, dip, peak)] == ["first", "dip", "peak"]
    assert_allclose(first[1:], [5.0, float(response.magnitude[0, 0])])
    assert_allclose(dip[1:], [20.325, 0.32133], rtol=2e-3)
    assert_allclose(peak[1:], [27.54, 10.163], rtol=2e-4)


def test_default_pairs_without_actuators_are_forces_at_the_sensors():
    case = jb.Case(jb.Beam(0.6, 11.68, 0.535), sensors=[jb.Sensor(0.25), jb.Sensor(0.3)])
    assert common_pairs(case) == (("force@0.25", "sensors.0"), ("force@0.3", "sensors.1"))
    found = frequency_response(case, [7.0]).values[0]
    assert_allclose(found[0], receptance(case, 7.0, 0.25, 0.25)[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("support", "place"), [(jb.Support(0.2), "0.4"), (jb.Support(0.2, stiffness=1e5), "0.2")]
)
def test_default_forces_are_not_on_rigid_supports(support, place):
    """A force on a rigid support moves nothing: that for a sensor there is in the longest span."""
    beam, sensor = jb.Beam(0.6, 11.68, 0.535), jb.Sensor(0.2, quantity="moment")
    case = jb.Case(beam, [support], sensors=[sensor, jb.Sensor(0.0, quantity="slope")])
    assert common_pairs(case) == ((f"force@{place}", "sensors.0"), ("force@0.4", "sensors.1"))
    assert np.all(frequency_response(case, [7.0]).magnitude > 1e-6)


INVALID = [
    ({"frequencies": [-1.0]}, "frequencies must be finite and not negative, in Hz; found -1"),
    ({"frequencies": [np.nan]}, "found nan"),
    ({"frequencies": [[1.0]]}, "frequencies must be a list of numbers, not of shape"),
    (
        {"stationary_masses": [(0.7, 0.1)]},
        "the position of a stationary mass must lie on the beam, between 0 and",
    ),
    ({"stationary_masses": [(0.3, -0.1)]}, "a stationary mass must not be negative; it is -0.1 kg"),
    ({"pairs": []}, "name at least one pair of an input and an output"),
    ({"pairs": [("actuators.1", "sensors.0")]}, "'actuators.1' does not exist; the case has 1"),
    ({"pairs": [("actuators.x", "sensors.0")]}, "'actuators.x' does not exist; the case has 1"),
    ({"pairs": [("actuators.0.current", "sensors.0")]}, "is driven by its command"),
    ({"pairs": [("push@0.3", "sensors.0")]}, "'push@0.3' must be a force, as force@0.3"),
    ({"pairs": [("force@0.8", "sensors.0")]}, "'force@0.8' must lie on the beam, between 0 and 0"),
    ({"pairs": [("force@x", "sensors.0")]}, "'force@x': 'x' is not a number in m"),
    ({"pairs": [("voltage", "sensors.0")]}, "the input 'voltage' does not exist; write, for"),
    ({"pairs": [("force@0.3", "sensors.2")]}, "'sensors.2' does not exist; the case has 2 sensors"),
    ({"pairs": [("force@0.3", "deflecton@0.3")]}, "did you mean 'deflection'?, as deflection@0.3"),
    ({"pairs": [("force@0.3", "actuators.0")]}, "it may be current, voltage, active_force"),
    ({"pairs": [("force@0.3", "actuators.0.curent")]}, "did you mean 'current'?"),
]


@pytest.mark.parametrize(("changes", "message"), INVALID)
def test_invalid_arguments_are_refused(changes, message):
    arguments = {"frequencies": [1.0], "pairs": None, "stationary_masses": ()} | changes
    with pytest.raises(ValueError) as caught:
        frequency_response(RIG_A, **arguments)
    assert message in str(caught.value)


def test_quantities_that_an_actuator_does_not_have_are_refused():
    case = jb.Case(RIG_A.beam, actuators=[jb.Shaker(0.5), jb.SpringDamper(0.2, 10.0)])
    with pytest.raises(ValueError, match="'actuators.0.current' does not exist: a Shaker has no"):
        frequency_response(case, [1.0], [("actuators.0", "actuators.0.current")])
    with pytest.raises(ValueError, match="'actuators.1' takes no command"):
        frequency_response(case, [1.0], [("actuators.1", "deflection@0.3")])
    with pytest.raises(ValueError, match="neither sensors nor actuators"):
        frequency_response(jb.Case(RIG_A.beam), [1.0])


def test_responses_of_a_batch_are_printed_and_none_are_refused():
    """Both raised where the first and last frequency were formatted."""
    case = jb.Case(jb.Beam(0.6, 11.68, 0.535), sensors=[jb.Sensor(0.3)])
    batch = jax.vmap(lambda f: jb.frequency_response(case, f))(np.array([10.0, 20.0]))
    assert repr(batch).startswith("FrequencyResponse\n  force@0.3 -> sensors.0")
    with pytest.raises(ValueError, match=r"must be a list of numbers, not of shape \(0,\)"):
        jb.frequency_response(case, [])
