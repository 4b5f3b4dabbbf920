"""Fits to frequency responses summed mode by mode with numpy."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.signal

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.model.frequency_responses import frequency_response
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import NOISE, RATE, Plant, patch, plant
from tests.tuning.fit import test_actuators_from_logs as rigs
from tuning import Log, ModalFit, identify, identify_from_modes
from tuning.fit.dataset import pad_cases
from tuning.fit.frequency_responses import Responses, identify_responses, responses_of
from tuning.modal.result import IdentifiedMode

LENGTH, RIGIDITY, DENSITY, DAMPING, MODES = 0.6, 11.68, 0.535, 0.02, 3
HAMMER, POSITIONS = 0.2, (0.15, 0.3)
FREQUENCIES = np.linspace(5, 300, 150)


def sum_of_modes(frequencies, rigidity=RIGIDITY, damping=DAMPING):
    """Receptances at the positions: sum of shape(x) shape(a) / (w_i^2 - w^2 + 2 i z w_i w)."""
    w = 2 * np.pi * frequencies[:, None]
    total = np.zeros((frequencies.size, len(POSITIONS)), complex)
    for i in range(1, MODES + 1):
        natural = (i * np.pi / LENGTH) ** 2 * np.sqrt(rigidity / DENSITY)
        amplitude = np.sin(i * np.pi * HAMMER / LENGTH) * 2 / (DENSITY * LENGTH)
        shape = np.sin(i * np.pi * np.array(POSITIONS) / LENGTH)
        total += amplitude * shape / (natural**2 - w**2 + 2j * damping * natural * w)
    return total


def measured(noise=0.01, **about):
    values = sum_of_modes(FREQUENCIES)
    rng = np.random.default_rng(0)
    relative_error = noise * (rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape))
    pairs = tuple((f"force@{HAMMER}", f"sensors.{i}") for i in range(2))
    return Responses(
        FREQUENCIES, values * np.exp(relative_error), pairs, source="hammer.csv", **about
    )


CASE = jb.Case(
    jb.Beam(length=LENGTH, flexural_rigidity=12.4, mass_per_length=DENSITY, damping_ratio=0.03,
            modes=MODES),
    sensors=[jb.Sensor(x) for x in POSITIONS],
)  # fmt: skip


def test_rigidity_and_damping_from_hammer_responses():
    fit = identify_responses(CASE, measured(), ["beam.flexural_rigidity", "beam.damping_ratio"])
    truth = np.array([RIGIDITY, DAMPING])
    assert np.all(np.abs(fit.values - truth) < 3.5 * fit.errors)
    assert np.all(fit.errors < [0.003 * RIGIDITY, 0.03 * DAMPING])
    np.testing.assert_allclose(fit.relative_misfit, 0.01 * np.sqrt(2), rtol=0.15)
    np.testing.assert_allclose(fit.fitted, sum_of_modes(FREQUENCIES, *fit.values), rtol=1e-6)
    assert fit.verdict == "converged" and "responses are off by 1.4 %" in str(fit)
    assert float(fit.case.beam.flexural_rigidity) == fit.values[0]


def test_responses_estimated_from_a_log_of_a_shaker():
    """Noise as command, readings by lsim: Welch's method estimates the response of the rig."""
    times = np.arange(60_001) / 1000.0
    volts = scipy.signal.lfilter(*scipy.signal.butter(2, 0.2), np.random.default_rng(0).normal(
        size=times.size))  # fmt: skip
    readings = rigs.respond(times, volts, 0 * volts)
    log = Log(times, np.column_stack([readings, volts]), ("a", "b", "u"),
              ("deflection", "deflection", "voltage"), ("m", "m", "V"),
              sensors=(0, 1, None), actuators=(None, None, 0))  # fmt: skip
    responses = responses_of(log, segment=4.0)
    assert responses.pairs == (("actuators.0", "sensors.0"), ("actuators.0", "sensors.1"))
    low = responses.frequencies < 100
    exact = frequency_response(rigs.case(), responses.frequencies[low], responses.pairs).values
    error = np.abs(responses.values[low] / np.asarray(exact) - 1)
    assert np.median(error) < 0.02
    with pytest.raises(ValueError, match="responses need one command and at least one sensor"):
        responses_of(dataclasses.replace(log, actuators=(None, None, None)))


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"frequencies": FREQUENCIES[::-1]}, "hammer.csv: frequencies must ascend from above 0 Hz"),
        ({"pairs": measured().pairs[:1]}, r"hammer.csv: \(150, 2\) values for 150 .* and 1 pairs"),
        (
            {"values": 0 * measured().values},
            "hammer.csv: the response of sensors.0 to force@0.2 at 5 Hz is 0j; leave this",
        ),
    ],
)
def test_faulty_responses(changes, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(measured(), **changes)


def test_pairs_that_do_not_exist():
    pairs = (("force@0.2", "sensors.0"), ("force@0.2", "sensors.7"))
    with pytest.raises(ValueError, match="'sensors.7' does not exist"):
        identify_responses(CASE, dataclasses.replace(measured(), pairs=pairs), ["beam.length"])


# Logs of different kinds in one fit: a crossing without control, and a patch that excites.


@pytest.fixture(scope="module")
def rig() -> Plant:
    """A beam of finite elements with a patch; accelerations need all modes of the plant."""
    sensors = [(0.2,), (0.35, "acceleration")]
    beam = plant(1, 13.211, 0.812, [patch(0.2575, 0.32)], [], {}, sensors, 4, "pinned-pinned")
    return dataclasses.replace(beam, modes=4)


def crossing_and_shaking(rig: Plant) -> list[Log]:
    """The deflection while a mass crosses, and the acceleration while the patch is driven."""
    noise = np.random.default_rng(0)
    times = np.arange(round(0.5 * RATE)) / RATE
    crossing = rig.readings(times, np.zeros((times.size, 1)))[:, :1]
    crossing = crossing + NOISE["deflection"] * noise.normal(size=crossing.shape)
    voltage = 2.0 * scipy.signal.chirp(times, 2.0, times[-1], 30.0)[:, None]
    shaken = rig.readings(times, voltage, loaded=False)[:, 1:]
    shaken = shaken + NOISE["acceleration"] * noise.normal(size=shaken.shape)
    return [
        Log(times, crossing, ("w",), ("deflection",), ("m",), "crossing", sensors=(0,)),
        Log(
            times,
            np.column_stack([shaken, voltage]),
            ("a", "u"),
            ("acceleration", "voltage"),
            ("m/s^2", "V"),
            "shaking",
            loads=(),
            sensors=(1, None),
            actuators=(None, 0),
        ),
    ]


def test_one_rig_fitted_to_both_logs(rig):
    start = {address: 1.06 * value for address, value in rig.truth.items()}
    fit = identify(replace(rig.case, start), crossing_and_shaking(rig), list(start))
    assert np.all(np.isfinite(fit.errors))
    deviations = (fit.values - list(rig.truth.values())) / fit.errors
    assert np.all(np.abs(deviations) < 3), dict(zip(rig.truth, deviations, strict=True))
    # Either log alone determines rigidity and correction of the patch less well.
    assert np.all(fit.errors / fit.values < [0.01, 0.03, 0.2, 0.03])


def test_cases_are_padded_without_effect(rig):
    times = np.linspace(0.0, 0.5, 6)
    table = jb.MovingMass(mass=0.3, times=[0.1, 0.4], positions=[0.0, 0.6])
    both = dataclasses.replace(rig.case, loads=(*rig.case.loads, table))
    driven = jb.Prescribed(np.zeros(1), times=times, values=np.ones((1, 6)))
    empty = dataclasses.replace(rig.case, loads=(), controller=driven)
    crossed, shaken = pad_cases([both, empty], [times, times])
    assert crossed.loads == both.loads and not np.any(crossed.controller.values)
    assert np.all(shaken.controller.values == 1.0)
    first, second = shaken.loads
    assert first.entry_time == 1.0 and float(second.times[0]) == 1.0
    assert float(second.times[1] - second.times[0]) == pytest.approx(0.3)


# Parameters of a beam recovered from modes of its finite elements, with noise as they state it.

PLACES = (1.0, 2.5, 4.0, 6.5, 8.0)
PORTAL_RIGIDITY, MASS, SPRING = 2e6, 200.0, 4e6


def beam(ends="pinned-pinned", spring=0.0):
    supports = (finite_elements.Support(6.0, stiffness=spring),) if spring else ()
    return finite_elements.assemble(
        finite_elements.Beam(10.0, PORTAL_RIGIDITY, MASS, ends, supports, elements=60), PLACES
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
        errors.append((fit.values[0] - PORTAL_RIGIDITY) / fit.errors[0])
        assert fit.values[0] == pytest.approx(PORTAL_RIGIDITY, rel=3e-3)
    # A relative deviation of 1e-3 in four frequencies: 2 * 1e-3 / sqrt(4) of the rigidity.
    assert fit.errors[0] == pytest.approx(1e-3 * PORTAL_RIGIDITY, rel=0.3)
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
    np.testing.assert_allclose(fit.values, [PORTAL_RIGIDITY, SPRING], rtol=0.02)
    low, high = fit.intervals.T
    assert np.all(low <= [PORTAL_RIGIDITY, SPRING]) and np.all(high >= [PORTAL_RIGIDITY, SPRING])


def test_what_modes_do_not_tell_is_named():
    """Frequencies tell the ratio of rigidity and mass only."""
    fit = identify_from_modes(
        case(),
        identified(beam(), places=(None,) * 5),
        ["beam.flexural_rigidity", "beam.mass_per_length"],
    )
    assert np.all(np.isinf(fit.errors)) and len(fit.unidentifiable) == 1
    ratio = fit.values[0] / fit.values[1]
    assert ratio == pytest.approx(PORTAL_RIGIDITY / MASS, rel=3e-3)


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
    assert fit.values[0] == pytest.approx(PORTAL_RIGIDITY, rel=3e-3)
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
