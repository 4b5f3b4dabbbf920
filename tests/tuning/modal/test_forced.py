"""Responses to measured forces of hammers and shakers, of structures by finite elements."""

import numpy as np
import pytest
from scipy.signal import firwin, lfilter

from tests.oracles.planted_structures import FINER, coloured_noise, response
from tests.tuning.modal.test_subspace import small_structure
from tuning import Log, ModalSettings, identify_modes
from tuning.modal.forced.likelihood import triangular_factor
from tuning.modal.forced.measured_responses import fit_common_denominator, products, transforms
from tuning.modal.result import mac_matrix

RATE = 40.0


def measured(structure, kind, seed, noise, duration=60.0):
    """Log of responses to one force: five impacts whose responses overlap, or a random force."""
    random = np.random.default_rng(seed)
    fine = FINER * RATE
    forces = np.zeros((int(duration * fine), structure.inputs.shape[1]))
    if kind == "shaker":
        forces[:, 0] = random.normal(size=len(forces))
    else:
        for start in 0.05 + 0.17 * np.arange(5) + 0.1 * random.uniform(size=5):
            first = int(start * len(forces))
            forces[first : first + 2 * FINER, 0] = np.sin(np.pi * (np.arange(8) + 0.5) / 8)
    # The anti-alias filter of the logger, for all channels.
    forces = lfilter(firwin(161, 0.8 / FINER), 1.0, forces, axis=0)
    values = response(structure, forces, fine)[::FINER]
    values = values + noise * values.std() * coloured_noise(random, values.shape)
    return Log(
        np.arange(len(values)) / RATE,
        np.column_stack([forces[::FINER, 0], values]),
        ("hammer", "v1", "v2"),
        ("force", "velocity", "velocity"),
        ("N", "m/s", "m/s"),
        "planted",
    )


def test_exact_responses_have_exact_poles():
    """Samples of a discrete system with states at its start and end: no leakage."""
    random = np.random.default_rng(0)
    poles = 2 * np.pi * np.array([3.0, 3.03, 9.0]) * (-np.array([0.002, 0.003, 0.01]) + 1j)
    force = random.normal(size=(1500, 1))
    values = np.zeros((1500, 2))
    for root in np.exp(poles / RATE):
        one = lfilter([1.0], [1.0, -root], force[:, 0] + 0j)
        values += np.real(np.multiply.outer(one, random.normal(size=2) * (1 + 0.3j)))
    lines = transforms((values[500:],), (force[500:],), RATE, (1.0, 19.0))
    found = fit_common_denominator(products(lines, 7), 6).poles
    np.testing.assert_allclose(found[np.argsort(np.abs(found))], poles, rtol=1e-6)


def test_shapes_of_an_early_impact_do_not_depend_on_the_degree():
    """The spectrum of an impact early in a record is nearly a sum of powers of z, as a transient
    is.

    Of high degrees both gains had been large and of opposite sign, and shapes arbitrary.
    """
    random = np.random.default_rng(0)
    poles = 2 * np.pi * np.array([3.0, 3.1, 9.0]) * (-np.array([0.004, 0.01, 0.005]) + 1j)
    shapes, force = random.normal(size=(3, 4)), np.zeros(3000)
    force[30:34] = np.sin(np.pi * (np.arange(4) + 0.5) / 4)
    values = np.zeros((3000, 4))
    for root, shape in zip(np.exp(poles / RATE), shapes, strict=True):
        one = lfilter([1.0], [1.0, -root], force + 0j)
        values += np.real(np.multiply.outer(one, shape))
    values += 0.01 * values.std() * random.normal(size=values.shape)
    lines = transforms((values,), (force[:, None],), RATE, (1.0, 12.0))
    system = products(lines, 40)
    for degree in (20, 30, 40):
        found = fit_common_denominator(system, degree)
        nearest = np.argmin(np.abs(found.poles[:, None] - poles), axis=0)
        mac = np.diag(mac_matrix(found.shapes[nearest], shapes + 0j))
        assert np.all(mac > 0.95), (degree, mac)


@pytest.mark.parametrize("kind", ["impacts", "shaker"])
def test_modes_are_found_within_their_intervals(kind):
    structure = small_structure(0)
    covered = []
    for seed in range(2):
        fit = identify_modes(measured(structure, kind, seed, 0.1), band=(2.0, 11.0))
        assert fit.kind == "measured force" and fit.method == "plscf"
        assert fit.log.names == ("v1", "v2") and "measured force hammer, which" in str(fit)
        np.testing.assert_allclose(fit.frequencies, structure.frequencies, rtol=1e-3)
        np.testing.assert_allclose(fit.damping_ratios, structure.damping_ratios, rtol=0.1)
        assert np.all(np.diag(mac_matrix(fit.shapes, structure.shapes + 0j)) > 0.999)
        for found, truth in (
            (fit.frequency_intervals, structure.frequencies),
            (fit.damping_intervals, structure.damping_ratios),
        ):
            covered.append((found[:, 0] <= truth) & (truth <= found[:, 1]))
    # Of 12 intervals of 95 % three or more miss with a probability of 2 %.
    assert np.sum(~np.array(covered)) < 3


def test_close_modes_of_a_hammer_test_are_told_apart():
    """One per cent apart, in two records taken together."""
    structure = small_structure(0)._replace(
        frequencies=np.array([4.0, 4.04, 9.0]), damping_ratios=np.array([0.004, 0.005, 0.008])
    )
    logs = [measured(structure, "impacts", seed, 0.05) for seed in range(2)]
    fit = identify_modes(logs, band=(2.0, 11.0), settings=ModalSettings(force=["hammer"]))
    np.testing.assert_allclose(fit.frequencies, structure.frequencies, rtol=1e-3)


def test_a_hammer_that_strikes_another_place_in_each_log():
    """Two modes 1 % apart, of which each place excites one more: one fit of both forces."""
    structure = small_structure(0)._replace(
        frequencies=np.array([4.0, 4.04, 9.0]), damping_ratios=np.array([0.004, 0.005, 0.008])
    )
    logs = []
    for place in range(2):
        turned = structure._replace(inputs=np.roll(structure.inputs, -place, axis=1))
        one = measured(turned, "impacts", place, 0.05, 30.0)
        names = (f"at {place}", *one.names[1:])
        logs.append(Log(one.times, one.values, names, one.quantities, one.units, one.source))
    fit = identify_modes(logs, band=(2.0, 11.0))
    np.testing.assert_allclose(fit.frequencies, structure.frequencies, rtol=1e-3)
    np.testing.assert_allclose(fit.damping_ratios, structure.damping_ratios, rtol=0.05)
    assert np.all(np.diag(mac_matrix(fit.shapes, structure.shapes + 0j)) > 0.99)
    assert "at 0 and at 1" in str(fit)
    with pytest.raises(ValueError, match="no channel 'at 2'"):
        identify_modes(logs, band=(2.0, 11.0), settings=ModalSettings(force=["at 2"]))


def test_two_forces_at_once():
    """Shakers at two places, whose forces are correlated."""
    structure, random = small_structure(0), np.random.default_rng(5)
    fine = FINER * RATE
    forces = np.zeros((int(60 * fine), structure.inputs.shape[1]))
    forces[:, :2] = random.normal(size=(len(forces), 2)) @ [[1.0, 0.5], [0.0, 1.0]]
    forces = lfilter(firwin(161, 0.8 / FINER), 1.0, forces, axis=0)
    values = response(structure, forces, fine)[::FINER]
    values = values + 0.1 * values.std() * coloured_noise(random, values.shape)
    log = Log(
        np.arange(len(values)) / RATE,
        np.column_stack([forces[::FINER, :2], values]),
        ("f1", "f2", "v1", "v2"),
        ("force", "force", "velocity", "velocity"),
        ("N", "N", "m/s", "m/s"),
        "planted",
    )
    fit = identify_modes(log, band=(2.0, 11.0))
    np.testing.assert_allclose(fit.frequencies, structure.frequencies, rtol=1e-3)
    assert np.all(np.diag(mac_matrix(fit.shapes, structure.shapes + 0j)) > 0.999)


def test_noise_beside_a_force_has_no_modes():
    random = np.random.default_rng(7)
    values = np.column_stack([random.normal(size=2400), coloured_noise(random, (2400, 2))])
    log = Log(
        np.arange(2400) / RATE, values, ("f", "v1", "v2"), ("force", "velocity", "velocity"),
        ("N", "m/s", "m/s"), "noise",
    )  # fmt: skip
    assert not identify_modes(log, band=(2.0, 11.0)).modes


def test_a_force_is_no_response():
    log = measured(small_structure(0), "shaker", 0, 0.1, 20.0)
    fit = identify_modes(log, band=(2.0, 11.0), method="covariance")
    assert fit.kind == "ambient" and fit.log.names == ("v1", "v2")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"force": ["v1"]}, "channel 'v1' is in m/s, which is no force; give its unit as N"),
        ({"force": ["f"]}, "the log has no channel 'f'"),
        ({"force": ["hammer"], "method": "data"}, "used by method 'plscf', not by 'data'"),
        ({"force": ["hammer"], "kind": "ambient"}, "leave out kind 'ambient'"),
        ({"channels": ["hammer"]}, "the log has forces only, and no response to them"),
        ({"force_window": 1.0}, "the measured force has no impacts of a hammer"),
        ({"force": ["zero"]}, "a measured force is zero throughout; leave it out"),
    ],
)
def test_mistakes(arguments, message):
    arguments = dict(arguments)
    log = measured(small_structure(0), "shaker", 0, 0.1, 20.0)
    values = np.column_stack([log.values, np.zeros(log.times.size)])
    log = Log(
        log.times, values, (*log.names, "zero"), (*log.quantities, "force"), (*log.units, "N")
    )
    with pytest.raises(ValueError, match=message):
        chosen = {key: arguments.pop(key) for key in ("force", "force_window") if key in arguments}
        identify_modes(log, band=(2.0, 11.0), settings=ModalSettings(**chosen), **arguments)


def test_steps_by_products_are_those_of_orthogonal_columns():
    """The factor of the products is that of QR, also where products would lose it (one impact)."""
    random = np.random.default_rng(3)
    columns = random.normal(size=(400, 5)) + 1j * random.normal(size=(400, 5))
    other = random.normal(size=400)
    for apart in (1.0, 1e-5):
        columns[:, 3] = columns[:, 1] + apart * other
        rows = np.concatenate([columns.real, columns.imag])
        expected = np.linalg.qr(rows, mode="r")
        found = triangular_factor(columns)
        signs = np.sign(np.diag(found) / np.diag(expected))
        np.testing.assert_allclose(signs[:, None] * found, expected, atol=1e-9, rtol=1e-9)
