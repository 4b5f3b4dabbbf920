"""Parameters of a beam recovered from modes of its finite elements, with noise as they state it."""

import dataclasses
import json

import numpy as np
import pytest

import jaxbeam as jb
from tests.oracles import finite_elements
from tuning import Log, ModalFit, identify_from_modes
from tuning.modal.result import IdentifiedMode

PLACES = (1.0, 2.5, 4.0, 6.5, 8.0)
RIGIDITY, MASS, SPRING = 2e6, 200.0, 4e6


def beam(ends="pinned-pinned", spring=0.0):
    supports = (finite_elements.Support(6.0, stiffness=spring),) if spring else ()
    return finite_elements.assemble(
        finite_elements.Beam(10.0, RIGIDITY, MASS, ends, supports, elements=60), PLACES
    )


def identified(model, count=4, sd=1e-3, seed=0, places=PLACES) -> ModalFit:
    """Modes of finite elements with noise of a relative standard deviation."""
    random = np.random.default_rng(seed)
    omega, shapes = model.modes(count)
    rows = np.array([model.shape(x) for x in PLACES])
    found = []
    for w, shape in zip(omega, (rows @ shapes).T, strict=True):
        f = w / (2 * np.pi) * (1 + sd * random.normal())
        unit = shape / shape[np.argmax(np.abs(shape))] + 0.01 * random.normal(size=len(PLACES))
        unit = unit / unit[np.argmax(np.abs(unit))]
        covariance = np.diag(np.full(2 * len(PLACES), 1e-6))
        found.append(
            IdentifiedMode(f, sd * f, 0.01, 0.002, 0.2, unit + 0j, covariance)
        )  # fmt: skip
    log = Log(
        np.arange(9.0), np.zeros((9, 5)), tuple("abcde"), ("acceleration",) * 5, ("g",) * 5,
        positions=places,
    )  # fmt: skip
    return ModalFit(
        tuple(found), (), "ambient", "covariance", ((0.0, 8.0),), (1.0, 90.0), (), (), (), (), log,
        np.arange(9.0), np.zeros((9, 5)), None,
    )  # fmt: skip


def case(rigidity=1.2e6, spring=None):
    supports = [] if spring is None else [jb.Support(position=6.0, stiffness=spring)]
    return jb.Case(
        beam=jb.Beam(
            length=10.0, flexural_rigidity=rigidity, mass_per_length=MASS, damping_ratio=0.01,
            modes=6,
        ),
        supports=supports,
    )  # fmt: skip


def test_flexural_rigidity_and_its_interval():
    errors = []
    for seed in range(6):
        fit = identify_from_modes(case(), identified(beam(), seed=seed), ["beam.flexural_rigidity"])
        errors.append((fit.values[0] - RIGIDITY) / fit.errors[0])
        assert fit.values[0] == pytest.approx(RIGIDITY, rel=3e-3)
    # A relative deviation of 1e-3 in four frequencies: 2 * 1e-3 / sqrt(4) of the rigidity.
    assert fit.errors[0] == pytest.approx(1e-3 * RIGIDITY, rel=0.3)
    assert np.max(np.abs(errors)) < 3.5 and np.sqrt(np.mean(np.square(errors))) < 2
    assert [pair[:2] for pair in fit.pairs] == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert min(pair[2] for pair in fit.pairs) > 0.99
    assert json.loads(json.dumps(fit.to_dict()))["pairs"][0]["mode"] == 0
    assert "MAC" in str(fit)


def test_spring_and_rigidity_although_the_order_of_modes_differs():
    """With the weak spring of the start, the modes that the spring raises are in other places."""
    fit = identify_from_modes(
        case(rigidity=1.5e6, spring=5e5),
        identified(beam(spring=SPRING)),
        {"beam.flexural_rigidity": (5e5, 1e7), "supports.0.stiffness": (1e5, 1e8)},
    )
    np.testing.assert_allclose(fit.values, [RIGIDITY, SPRING], rtol=0.02)
    low, high = fit.intervals.T
    assert np.all(low <= [RIGIDITY, SPRING]) and np.all(high >= [RIGIDITY, SPRING])


def test_what_modes_do_not_tell_is_named():
    """Frequencies tell the ratio of rigidity and mass only."""
    fit = identify_from_modes(
        case(),
        identified(beam(), places=(None,) * 5),
        ["beam.flexural_rigidity", "beam.mass_per_length"],
    )
    assert np.all(np.isinf(fit.errors)) and len(fit.unidentifiable) == 1
    ratio = fit.values[0] / fit.values[1]
    assert ratio == pytest.approx(RIGIDITY / MASS, rel=3e-3)


def test_shapes_that_are_not_known_everywhere():
    """As of setups, one of which does not show a mode; or none are compared, of two quantities."""
    whole = identified(beam())
    modes = list(whole.modes)
    for k, place in ((0, 2), (1, 0)):
        shape, covariance = modes[k].shape.copy(), modes[k].shape_covariance.copy()
        shape[place] = covariance[place] = covariance[:, place] = np.nan
        modes[k] = modes[k]._replace(shape=shape, shape_covariance=covariance)
    part = dataclasses.replace(whole, modes=tuple(modes))
    fit = identify_from_modes(case(), part, ["beam.flexural_rigidity"])
    assert fit.values[0] == pytest.approx(RIGIDITY, rel=3e-3)
    assert [pair[:2] for pair in fit.pairs] == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert 0.99 < min(pair[2] for pair in fit.pairs) < 1.0
    log = dataclasses.replace(whole.log, quantities=("deflection", *("acceleration",) * 4))
    mixed = dataclasses.replace(whole, log=log)
    fit = identify_from_modes(case(), mixed, ["beam.flexural_rigidity"])
    assert {pair[2] for pair in fit.pairs} == {1.0}, "without shapes"


def test_mistakes():
    many = identified(beam(), count=8)
    with pytest.raises(ValueError, match="the case has 6 modes, 8 were identified: raise beam"):
        identify_from_modes(case(), many, ["beam.flexural_rigidity"])
    none = identified(beam(), count=0)
    with pytest.raises(ValueError, match="no mode is well identified, nothing to fit to"):
        identify_from_modes(case(), none, ["beam.flexural_rigidity"])
