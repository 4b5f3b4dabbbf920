"""Responses to measured forces of hammers and shakers, of structures by finite elements."""

import numpy as np
import pytest
from scipy.signal import firwin, lfilter

import tuning
from tests.oracles.planted_structures import FINER, coloured_noise, response
from tests.tuning.modal.test_ambient import small_structure
from tuning import Log, ModalSettings, identify_modes
from tuning.modal.forced.likelihood import refined_poles, triangular_factor
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


def test_poles_leave_a_start_that_hardly_decays():
    """Steps are compared with the distance of lines, too: less is not told from nothing."""
    structure = small_structure(0)._replace(damping_ratios=np.array([0.002, 0.001, 0.0015]))
    values = measured(structure, "impacts", 0, 0.01).values
    lines = transforms((values[:, 1:],), (values[:, :1],), RATE, (1.0, 12.0))
    starts = structure.poles.imag * (1j - 1e-6)
    found = refined_poles(lines, starts, np.arange(starts.size))
    assert np.all(np.abs(found - structure.poles) < 0.15 * np.abs(structure.poles.real))


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


# Frequency responses to measured forces: closed forms of H1, H2, Hv; windows of impacts.


def gain_log(noise_in, noise_out):
    """A response of twice the force, with white noise in both."""
    random = np.random.default_rng(0)
    force, first, second = random.normal(size=(3, 40_000))
    values = np.stack([force + noise_in * first, 2 * force + 2 * noise_out * second], axis=1)
    return Log(
        np.arange(40_000) / RATE, values, ("f", "v1"), ("force", "velocity"), ("N", "m/s"), "gain"
    )


def hammer_log(seed=0, noise=0.02, duration=60.0):
    """Three impacts, a pulse of half a sine, and responses of a structure by finite elements."""
    structure = small_structure(0)
    fine = FINER * RATE
    forces = np.zeros((int(duration * fine), structure.inputs.shape[1]))
    for start in (0.02, 0.35, 0.68):
        first = int(start * len(forces))
        forces[first : first + 8, 0] = np.sin(np.pi * (np.arange(8) + 0.5) / 8)
    values = response(structure, forces, fine)[::FINER]
    values = values + noise * values.std() * coloured_noise(
        np.random.default_rng(seed), values.shape
    )
    # Mean force over a step, so that the pulse has its momentum.
    force = forces[:, 0].reshape(-1, FINER).mean(axis=1)
    log = Log(
        np.arange(len(values)) / RATE,
        np.column_stack([force, values]),
        ("hammer", "v1", "v2"),
        ("force", "velocity", "velocity"),
        ("N", "m/s", "m/s"),
        "hammer",
    )
    return structure, log


@pytest.mark.parametrize(
    ("estimator", "noise_in", "noise_out", "expected"),
    [
        ("H1", 0.0, 0.5, 2.0),
        ("H2", 0.0, 0.5, 2.0 * 1.25),
        ("Hv", 0.0, 0.5, 2.0 * 1.25**0.5),
        ("H1", 0.5, 0.0, 2.0 / 1.25),
        ("H2", 0.5, 0.0, 2.0),
        ("Hv", 0.5, 0.0, 2.0 / 1.25**0.5),
    ],
)
def test_noise_biases_as_theory_says(estimator, noise_in, noise_out, expected):
    found = tuning.modal.measured_responses(
        gain_log(noise_in, noise_out), estimator=estimator, segment=5.0
    )
    values, coherence = found.values[2:-2, 0, 0], found.coherence[2:-2, 0]
    np.testing.assert_allclose(np.mean(values), expected, rtol=0.01)
    np.testing.assert_allclose(np.mean(coherence), 1 / 1.25, atol=0.01)
    # Deviations (Bendat and Piersol): half the power of relative errors is in the magnitude.
    if estimator == "H1" and noise_out:
        spread = np.std(np.abs(values)) / expected
        averages = np.sqrt(found.averages / 399 * 1.5)  # overlap: fewer independent ones
        assert 0.7 < spread / (np.mean(found.deviations[2:-2]) * averages) < 1.4


def test_two_forces_are_told_apart():
    random = np.random.default_rng(1)
    forces = random.normal(size=(20_000, 2)) @ [[1.0, 0.4], [0.0, 1.0]]
    values = np.column_stack([forces, forces @ [2.0, -3.0]])
    log = Log(
        np.arange(20_000) / RATE, values, ("f1", "f2", "v"), ("force", "force", "velocity"),
        ("N", "N", "m/s"), "two",
    )  # fmt: skip
    found = tuning.modal.measured_responses(log)
    expected = np.tile([2.0, -3.0], (found.frequencies.size - 6, 1))
    np.testing.assert_allclose(found.values[3:-3, 0], expected, rtol=1e-6)
    with pytest.raises(ValueError, match="H2 is for one force, not 2; use H1"):
        tuning.modal.measured_responses(log, estimator="H2")


def test_windows_of_impacts(tmp_path):
    structure, log = hammer_log()
    plain = tuning.identify_modes(log, band=(2.0, 11.0))
    windowed = tuning.identify_modes(
        log, band=(2.0, 11.0), settings=tuning.ModalSettings(force_window=0.5)
    )
    for fit in (plain, windowed):
        np.testing.assert_allclose(fit.frequencies, structure.frequencies, rtol=2e-3)
        np.testing.assert_allclose(fit.damping_ratios, structure.damping_ratios, rtol=0.1)
    found = tuning.modal.measured_responses(log, exponential=4.0)
    assert found.averages == 3 and found.decay_rate == 0.25
    w = 2 * np.pi * structure.frequencies[0]
    assert found.true_damping_ratio(structure.frequencies[0], 0.02) == 0.02 - 0.25 / w
    found.plot(tmp_path / "responses.png")
    assert (tmp_path / "responses.png").stat().st_size > 10_000


def test_responses_to_impacts_are_those_of_the_structure():
    structure, log = hammer_log(noise=0.0)
    found = tuning.modal.measured_responses(log, exponential=3.0)
    w = 2 * np.pi * found.frequencies
    expected = 0
    for pole, shape, inputs in zip(
        structure.poles, structure.shapes, structure.inputs[:, 0], strict=True
    ):
        residue = -1j * pole / pole.imag
        s = 1j * w[:, None] - pole + found.decay_rate
        mirrored = 1j * w[:, None] - pole.conjugate() + found.decay_rate
        expected = expected + inputs * shape * (residue / s + residue.conjugate() / mirrored)
    near = np.abs(found.frequencies - structure.frequencies[0]) < 0.2
    # The pulse of the test is coarsely sampled: its size is free, the same for all lines.
    ratio = np.abs(found.values[near, :, 0]) / np.abs(expected[near])
    np.testing.assert_allclose(ratio, np.mean(ratio), rtol=0.03)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"estimator": "H3"}, "estimator must be H1, H2, Hv, not 'H3'"),
        ({"exponential": -1.0}, "the exponential window must last longer than 0 s"),
        ({"exponential": 1.0}, "windows are for impacts of a hammer"),
        ({"segment": 1e9}, "a segment of .* samples is not within"),
        ({"channels": ["v1"], "force": ["v1"]}, "which is no force"),
    ],
)
def test_mistakes_of_response(arguments, message):
    with pytest.raises(ValueError, match=message):
        tuning.modal.measured_responses(gain_log(0.0, 0.1), **arguments)
