"""Modes of several setups: shapes against finite elements and pyOMA-2, pairing, references."""

import dataclasses
import json

import numpy as np
import pytest
from pyoma2.functions.gen import merge_mode_shapes
from scipy.linalg import eigh

from tests.oracles.planted_structures import Structure, beam_matrices, coloured_noise, response
from tuning import Log, identify_modes
from tuning.modal import merge_setups
from tuning.modal.harmonics import Line
from tuning.modal.identify_modes import ModalFit
from tuning.modal.result import IdentifiedMode, mac_matrix
from tuning.modal.setups import Part, logs_of_setups, whole_shape

SHAPES = np.array([[0.6, 1.0, 0.7, 0.2, -0.3], [1.0, 0.1, -0.8, -0.6, 0.4]])


def mode(frequency, shape, sd=0.001, share=0.3, **others) -> IdentifiedMode:
    """A mode of relative frequency error 0.001, damping ratio 0.01 +- 0.001, shape error 0.01."""
    shape = np.array(shape, complex)
    shape = shape / shape[np.argmax(np.abs(shape))]
    covariance = np.diag(np.tile(1e-4 * (np.abs(shape) < 1), 2))
    values = (frequency, sd * frequency, 0.01, 0.001, share, shape, covariance)
    return IdentifiedMode(*values)._replace(**others)


def setup(modes, names, source="s", positions=(), rejected=(), lines=(), quantity="acceleration"):
    """Modes of a log with some channels, in the band from 1 to 50 Hz."""
    count = len(names)
    log = Log(
        np.arange(9.0), np.zeros((9, count)), tuple(names), (quantity,) * count, ("g",) * count,
        source, positions=tuple(positions),
    )  # fmt: skip
    return ModalFit(
        tuple(modes), tuple(rejected), "ambient", "covariance", ((0.0, 8.0),), (1.0, 50.0),
        tuple(lines), (), (), (), log, np.arange(9.0), np.zeros((9, count)), None,
    )  # fmt: skip


def two(frequencies=(5.0, 9.0), change=0.0, **others):
    """Two setups of the first three and of the first, second and last channels of five."""
    pair = list(zip(frequencies, SHAPES, strict=True))
    return [
        setup([mode(f, shape[:3]) for f, shape in pair], "abc", "one.csv"),
        setup([mode(f * (1 + change), shape[[0, 1, 4]]) for f, shape in pair], "abe", "two.csv",
              **others),
    ]  # fmt: skip


# --- Shapes ---


def random_parts(random, sd=0.0, count=9):
    """A shape, and parts of it with complex scales: three references, two other channels each."""
    truth = random.normal(size=count) + 0.2j * random.normal(size=count)
    parts = []
    for k in range(3):
        own = np.array([0, 1, 2, 3 + 2 * k, 4 + 2 * k])
        scale = random.normal() + 1j * random.normal()
        error = sd * (random.normal(size=5) + 1j * random.normal(size=5))
        parts.append(Part(scale * (truth[own] + error), abs(scale * sd) ** 2 * np.eye(10), own))
    return truth / truth[np.argmax(np.abs(truth))], parts


def test_parts_of_a_shape_are_scaled_to_each_other():
    for seed in range(20):
        truth, parts = random_parts(np.random.default_rng(seed))
        found = whole_shape(parts, 9)
        np.testing.assert_allclose(found.shape, truth, rtol=0, atol=1e-10)
        assert found.joined == (0, 1, 2)


def test_real_parts_of_a_shape_by_pyoma():
    """pyOMA-2 scales to the references of the first part, by a real factor."""
    for seed in range(20):
        _, parts = random_parts(np.random.default_rng(seed))
        parts = [part._replace(shape=part.shape.real + 0j) for part in parts]
        parts = [p._replace(shape=p.shape * s) for p, s in zip(parts, (1, -0.7, 2), strict=True)]
        for part in parts[1:]:
            part.shape[:3] = parts[0].shape[:3] * part.shape[0] / parts[0].shape[0]
        found = whole_shape(parts, 9)
        theirs = merge_mode_shapes([part.shape[:, None] for part in parts], [[0, 1, 2]] * 3)[:, 0]
        assert mac_matrix(found.shape[None], theirs[None])[0, 0] == pytest.approx(1, abs=1e-12)


def test_errors_of_a_merged_shape():
    """Standard deviations are those of 400 shapes from parts with random errors."""
    truth, _ = random_parts(np.random.default_rng(3))
    errors, stated, misfits = [], [], []
    for seed in range(400):
        random = np.random.default_rng(3)
        _, exact = random_parts(random)
        noise = np.random.default_rng(1000 + seed)
        parts = []
        for part in exact:
            sd = 0.01 * np.abs(part.shape).max()
            error = sd * (noise.normal(size=5) + 1j * noise.normal(size=5))
            parts.append(Part(part.shape + error, sd**2 * np.eye(10), part.channels))
        found = whole_shape(parts, 9)
        errors.append(np.concatenate([(found.shape - truth).real, (found.shape - truth).imag]))
        stated.append(np.diag(found.covariance) / max(found.misfit, 1.0) ** 2)
        misfits.append(found.misfit**2)
    variance, expected = np.var(errors, axis=0), np.mean(stated, axis=0)
    moving = expected > 0
    assert np.sum(~moving) == 2, "the largest component is one"
    np.testing.assert_allclose(variance[moving] / expected[moving], 1.0, atol=0.35)
    assert np.mean(variance[moving] / expected[moving]) == pytest.approx(1.0, abs=0.1)
    assert np.mean(misfits) == pytest.approx(1.0, abs=0.1)


def test_parts_that_disagree_widen_the_errors():
    truth, parts = random_parts(np.random.default_rng(5), sd=0.1)
    smaller = [part._replace(covariance=part.covariance / 100) for part in parts]
    loose, tight = whole_shape(parts, 9), whole_shape(smaller, 9)
    assert tight.misfit == pytest.approx(10 * loose.misfit, rel=0.05) and tight.misfit > 3
    ratio = np.diag(tight.covariance) / np.maximum(np.diag(loose.covariance), 1e-30)
    assert np.median(ratio) == pytest.approx(1 / max(loose.misfit, 1.0) ** 2 * loose.misfit**2,
                                             rel=0.1)  # fmt: skip


def test_a_part_whose_references_do_not_move_is_left_out():
    truth, parts = random_parts(np.random.default_rng(6), sd=0.01)
    still = parts[1].shape.copy()
    still[:3] *= 1e-3
    found = whole_shape([parts[0], parts[1]._replace(shape=still), parts[2]], 9)
    assert found.joined == (0, 2)
    assert np.flatnonzero(np.isnan(found.shape)).tolist() == [5, 6]
    assert np.isnan(found.covariance[5]).all() and np.isfinite(found.covariance[7, 8])


# --- Pairs, means, notes ---


def test_merged_modes():
    fit = merge_setups(two())
    assert fit.channels.names == ("a", "b", "c", "e") and fit.references == ("a", "b")
    np.testing.assert_allclose(fit.frequencies, [5.0, 9.0])
    np.testing.assert_allclose([m.frequency_sd for m in fit.modes], [0.005 / 2**0.5] * 2 * np.array(
        [1, 1.8]), rtol=1e-12)  # fmt: skip
    np.testing.assert_allclose([m.damping_sd for m in fit.modes], 0.001 / 2**0.5)
    for found, shape in zip(fit.shapes, SHAPES[:, [0, 1, 2, 4]], strict=True):
        np.testing.assert_allclose(found, shape / shape[np.argmax(np.abs(shape))], atol=1e-9)
    assert fit.pairs == ({0: 0, 1: 0}, {0: 1, 1: 1}) and not fit.rejected
    assert "references, the same in setups: a, b  [--references" in str(fit)
    told = json.loads(json.dumps(fit.to_dict()))
    assert told["channels"] == ["a", "b", "c", "e"] and told["modes"][1]["setups"] == [0, 1]
    assert [one["frequencies_hz"] for one in told["setups"]] == [[5.0, 9.0]] * 2


def test_setups_that_disagree_widen_intervals_and_are_named():
    fit = merge_setups(two(change=0.02))
    assert "frequencies of the setups differ by more than their errors" in str(fit)
    np.testing.assert_allclose(fit.frequencies, [5.05, 9.09], rtol=1e-3)
    # Two values 2 % apart: their mean is off by half of that, one standard deviation.
    np.testing.assert_allclose([m.frequency_sd for m in fit.modes], [0.05, 0.09], rtol=0.02)
    assert "differ" not in str(merge_setups(two(change=0.001)))


def test_close_modes_are_paired_by_their_shapes():
    """Modes 1 % apart whose order is another in the second setup."""
    one, _ = two((5.0, 5.05))
    swapped = [mode(5.02, SHAPES[1][[0, 1, 4]]), mode(5.06, SHAPES[0][[0, 1, 4]])]
    fit = merge_setups([one, setup(swapped, "abe")])
    assert fit.pairs == ({0: 0, 1: 1}, {0: 1, 1: 0})


def test_a_mode_that_one_setup_lacks():
    one, other = two()
    alone = mode(20.0, [1.0, 0.5, 0.2])
    only = dataclasses.replace(one, modes=(*one.modes, alone))
    fit = merge_setups([only, other])
    assert "20 Hz: not found in two.csv" in str(fit)
    assert "20 Hz: the shape is unknown at e" in str(fit)
    assert np.isnan(fit.shapes[2][3]) and np.isfinite(fit.mac).all()
    assert fit.modes[2].collinearity == pytest.approx(1.0)
    assert (
        json.loads(json.dumps(fit.to_dict(), allow_nan=False))["modes"][2]["shape_real"][3] is None
    )
    weak = dataclasses.replace(one, modes=(*one.modes, alone._replace(energy_share=0.01)))
    fit = merge_setups([weak, other])
    assert len(fit.modes) == 2 and "20.0000  found in one.csv alone, and weak" in str(fit)
    narrow = dataclasses.replace(other, band=(1.0, 15.0))
    assert "20 Hz: not in two.csv, whose band is 1 Hz to 15 Hz" in str(merge_setups([only, narrow]))


def test_the_shape_of_a_mode_that_is_uncertain_in_a_setup():
    one, other = two()
    uncertain = dataclasses.replace(
        other, modes=other.modes[:1], rejected=((other.modes[1], "noisy"),)
    )
    fit = merge_setups([one, uncertain])
    assert "9 Hz: of two.csv the shape alone is used: noisy" in str(fit)
    assert fit.pairs[1] == {0: 1} and fit.modes[1].damping_sd == 0.001
    np.testing.assert_allclose(fit.shapes[1], SHAPES[1][[0, 1, 2, 4]], atol=1e-9)
    poor = other.modes[1]._replace(energy_share=0.001)
    for left, lines in (
        (poor, ()),
        (other.modes[1]._replace(frequency=9.2), ()),
        (other.modes[1], (Line(9.0, 0.2, 0j),)),
    ):
        without = dataclasses.replace(uncertain, rejected=((left, "noisy"),), lines=lines)
        assert "9 Hz: not found in two.csv" in str(merge_setups([one, without]))


def test_references_near_a_node():
    """A shape with next to nothing at the common channels is no guide to its scale."""
    node = np.array([1e-3, -2e-3, 1.0])
    pair = [setup([mode(5.0, node)], "abc", "one.csv"), setup([mode(5.0, node)], "abe", "two.csv")]
    fit = merge_setups(pair)
    assert "5 Hz: the shape of two.csv cannot be scaled, as the mode hardly moves" in str(fit)
    assert fit.modes[0].frequency_sd == pytest.approx(0.005 / 2**0.5)


# --- Channels ---


def test_which_channels_are_one_place():
    modes = [mode(5.0, SHAPES[0][:3])]
    places = setup(modes, "abc", "one.csv", (1.0, 2.0, 3.0))
    moved = setup(modes, "abc", "two.csv", (1.0, 2.0, 4.0))
    fit = merge_setups([places, moved])
    assert fit.channels.names == ("a", "b", "c at 3 m", "c at 4 m")
    assert fit.channels.positions == (1.0, 2.0, 3.0, 4.0)
    # Without positions the user says which channels stay.
    one, other = setup(modes, "abc", "one.csv"), setup(modes, "abc", "two.csv")
    fit = merge_setups([one, other], references=["a"])
    assert fit.channels.names == ("a", "b of one", "c of one", "b of two", "c of two")
    assert fit.references == ("a",) and not fit.choices
    assert merge_setups([one, other]).channels.names == ("a", "b", "c")


def test_setups_in_a_chain():
    """The first and last setup have no channel in common, but both have one with the second."""
    shape = np.array([0.5, 1.0, 0.8, -0.4])
    chain = [setup([mode(5.0, shape[[k, k + 1]])], "abcd"[k : k + 2]) for k in range(3)]
    np.testing.assert_allclose(merge_setups(chain).shapes[0], shape, atol=1e-9)


def test_mistakes():
    one, other = two()
    with pytest.raises(ValueError, match="the modes of two setups or more, not 1"):
        merge_setups([one])
    with pytest.raises(ValueError, match="two.csv: no channel 'c', which is to be a reference"):
        merge_setups([one, other], references=["a", "c"])
    apart = setup(other.modes, "xyz", "two.csv")
    with pytest.raises(ValueError, match="two.csv: no channel is common with one.csv"):
        merge_setups([one, apart])
    velocities = setup(other.modes, "abe", "two.csv", quantity="velocity")
    with pytest.raises(ValueError, match="same name, quantity and position in both"):
        merge_setups([one, velocities])
    assert "no mode is well identified" in str(merge_setups([setup([], "ab"), setup([], "ac")]))
    stranger = setup([mode(7.0, SHAPES[0][[0, 1, 4]])], "abe", "two.csv")
    assert "no mode is common to two setups" in str(merge_setups([one, stranger]))


def record(names, positions=(), rate=100.0, quantity="acceleration"):
    """A log of nothing."""
    return Log(
        np.arange(100) / rate, np.zeros((100, len(names))), tuple(names),
        (quantity,) * len(names), ("g",) * len(names), positions=positions,
    )  # fmt: skip


def test_logs_are_grouped_by_their_channels():
    same, again, other = record("ab"), record("ab"), record("ac")
    assert logs_of_setups([same, other, again]) == [[same, again], [other]]
    faster, placed = record("ab", rate=200.0), record("ab", (1.0, 2.0))
    assert [len(group) for group in logs_of_setups([same, faster, placed, again])] == [2, 1, 1]
    assert logs_of_setups([same, again], ["a"]) == [[same], [again]]
    # Of the channels that are used none is common.
    with pytest.raises(ValueError, match="no channel is common"):
        logs_of_setups([same, other], channels=["b", "c"])
    with pytest.raises(ValueError, match="references connect several setups, and this is one log"):
        logs_of_setups([same], ["a"])
    with pytest.raises(
        ValueError, match=r"the same channels, positions.*merged by tuning.modal.merge_s"
    ):
        identify_modes([placed, record("ab", (1.0, 3.0))])


# --- From samples to modes ---


def test_a_beam_of_finite_elements_in_three_setups():
    """Ambient response, two references and two sensors that move, noise of 10 %."""
    masses, stiffness = beam_matrices(20.0, 400 * (6 * np.pi * 400 / np.pi**2) ** 2, 400.0)
    keep = [i for i in range(len(masses)) if i not in (0, len(masses) - 2)]
    squares, vectors = eigh(stiffness[np.ix_(keep, keep)], masses[np.ix_(keep, keep)],
                            subset_by_index=[0, 3])  # fmt: skip
    every = np.zeros((len(masses), 4))
    every[keep] = vectors
    frequencies, damping = np.sqrt(squares) / (2 * np.pi), np.array([0.012, 0.01, 0.015, 0.008])
    fits = []
    for k, nodes in enumerate(((3, 9, 5, 7), (3, 9, 11, 13), (3, 9, 15, 2))):
        random = np.random.default_rng(50 + k)
        structure = Structure(
            frequencies, damping, every[[2 * n for n in nodes]].T, every[[4, 20]].T
        )
        values = response(structure, random.normal(size=(120 * 240, 2)), 240.0)
        values += 0.1 * values.std() * coloured_noise(random, values.shape)
        names = ("r1", "r2", *(f"n{n}" for n in nodes[2:]))
        columns = ("velocity",) * 4, ("m/s",) * 4, f"setup{k + 1}"
        log = Log(np.arange(len(values)) / 240.0, values, names, *columns,
                  positions=tuple(1.25 * n for n in nodes))  # fmt: skip
        fits.append(identify_modes(log, band=(1.5, 60.0)))
    fit = merge_setups(fits)
    assert fit.channels.names == ("r1", "r2", "n5", "n7", "n11", "n13", "n15", "n2")
    nodes = [round(position / 1.25) for position in fit.channels.positions]
    assert len(fit.modes) == 4
    z_frequency = (fit.frequencies - frequencies) / [m.frequency_sd for m in fit.modes]
    z_damping = (fit.damping_ratios - damping) / [m.damping_sd for m in fit.modes]
    assert np.abs([z_frequency, z_damping]).max() < 3.0
    deviations = []
    for found, one in zip(fit.modes, every.T, strict=True):
        truth = one[[2 * n for n in nodes]]
        truth = truth / truth[np.argmax(np.abs(found.shape))]
        sd = np.sqrt(np.diag(found.shape_covariance)[:8])
        np.testing.assert_allclose(found.shape.real, truth, atol=0.05)
        deviations += ((found.shape.real - truth)[sd > 0] / sd[sd > 0]).tolist()
    assert np.mean(np.abs(deviations) < 1.96) > 0.8
    assert max(m.frequency_sd for m in fit.modes) > 0
    for k, one in enumerate(fits):
        merged = np.array([m.damping_sd for m in fit.modes])
        own = np.array([one.modes[pairs[k]].damping_sd for pairs in fit.pairs])
        assert np.mean(merged / own) < 0.9, "three setups tell more than one"
