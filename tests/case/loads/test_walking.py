"""Steps of pedestrians and crowds: published factors, half-sine pulses, resonance, bad input.

Pedestrian streams against the closed form of a pinned beam, and people who stand in step.
"""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad, solve_ivp

import jaxbeam as jb
from jaxbeam.analysis.footbridges import comfort_class, harmonic_fractions, stream_response
from jaxbeam.case.library.published import line_loads
from jaxbeam.case.loads.walking import contact_time, jogging_factors, walking_factors
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.load_set import load_set
from tests.differences import central

BEAM = jb.Beam(
    length=30.0, flexural_rigidity=2.87e9, mass_per_length=1500.0, damping_ratio=0.005, modes=2
)


def case_of(*loads, duration=25.0) -> jb.Case:
    return jb.Case(BEAM, loads=loads, sensors=[jb.Sensor(15.0)], run=jb.Run(duration, 50.0))


def test_factors_of_walking():
    # At 2 Hz: 0.41 x 1.05, 0.069 + 0.0056 x 4, 0.033 + 0.0064 x 6, 0.013 + 0.0065 x 8; at 2.6 Hz
    # the first is limited.
    assert_allclose(walking_factors(np.array(2.0)), [0.4305, 0.0914, 0.0714, 0.065], rtol=1e-12)
    assert walking_factors(np.array(2.6))[0] == 0.56


@pytest.mark.parametrize("share", [0.25, 0.5, 0.69, 0.9])
def test_jogging_is_a_half_sine(share):
    """Its Fourier coefficients by quadrature, also where the closed form is 0 / 0."""
    pace = 2.5
    contact = share / pace
    factors, phases = jogging_factors(np.array(pace), np.array(contact), 3)

    def pulse(t):
        return np.pi / 2 / share * np.sin(np.pi * t / contact)  # mean of one

    for i in (1, 2, 3):
        sine, cosine = (
            2
            * pace
            * quad(lambda t, g=g, i=i: pulse(t) * g(2 * np.pi * i * pace * t), 0, contact)[0]
            for g in (np.sin, np.cos)
        )
        moments = [sine, cosine]
        found = factors[i - 1] * np.array([np.cos(phases[i - 1]), np.sin(phases[i - 1])])
        assert_allclose(found, moments, atol=1e-10)


def test_a_jogger_of_a_given_contact_time_is_a_row_of_half_sines():
    """Each step carries the weight of its period: W pi T / (2 t_c) sin(pi t / t_c)."""
    jogger = jb.Pedestrian(
        pace=2.5, weight=700.0, activity="jogging", contact_time=0.3, harmonics=100, speed=2.0
    )
    check_case(jb.Case(jb.Beam(20.0, 1e9, 2e3), loads=[jogger]))
    times = np.linspace(0.0, 0.8, 81)  # of two steps
    since = times % 0.4
    pulse = 700.0 * np.pi * 0.4 / (2 * 0.3) * np.sin(np.pi * since / 0.3)
    found = 700.0 + jogger.step_history(np.array(2.5), 0.0).at(times)
    assert_allclose(found, np.where(since < 0.3, pulse, 0.0), atol=5.0)


def test_contact_time_of_a_jogger():
    assert_allclose(contact_time(np.array(2.5)), 0.2751, atol=1e-4)  # 1.8 x 2.5^-2.05


def test_a_crowd_is_its_pedestrians():
    crowd = jb.Crowd(
        people=5, length=40.0, pace=1.9, pace_deviation=0.1, speed=1.4, seed=3, entry_time=1.0
    )
    case = case_of(crowd)
    loads = load_set(case)
    assert loads.wheel_count == 5
    walkers = []
    for i, history in loads.wheels.histories.items():
        pace = float(history.frequencies[0, 0])
        step = -float(history.phases[0, 0]) / (2 * np.pi * pace)
        entry = 1.0 + float(loads.behind[0][i]) / 1.4
        walkers.append(jb.Pedestrian(pace=pace, speed=1.4, entry_time=entry, step_time=step))
    together, alone = jb.simulate(case), jb.simulate(case_of(*walkers))
    size = np.max(np.abs(alone.deflection))
    assert_allclose(together.deflection, alone.deflection, atol=1e-9 * size)
    assert len({w.pace.item() for w in walkers}) == 5
    other = load_set(case_of(dataclasses.replace(crowd, seed=4)))
    assert not np.allclose(other.behind[0], loads.behind[0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pace": 0.9}, r"loads.0.pace must exceed 0.95 Hz"),
        ({"phases": [0.0]}, r"loads.0.phases belong to own factors"),
        ({"contact_time": 0.2}, r"contact_time is that of activity = 'jogging'"),
        ({"activity": "jogging", "contact_time": 0.6}, r"contact_time must be less than"),
        ({"factors": [0.4], "phases": [0.0, 1.0]}, r"loads.0.phases has 2"),
        ({"position": 3.0}, r"loads.0 has both position and speed"),
    ],
)
def test_bad_input(changes, words):
    load = jb.Pedestrian(**({"pace": 2.0, "speed": 1.5} | changes))
    with pytest.raises(ValueError, match=words):
        check_case(case_of(load))


def test_too_wide_a_crowd():
    crowd = jb.Crowd(people=5, length=40.0, pace=1.9, pace_deviation=0.4, speed=1.4)
    with pytest.raises(ValueError, match="the slowest pace"):
        check_case(case_of(crowd))


def test_a_given_force_below_zero_is_no_loss_of_contact():
    """Harmonics of jogging, cut off after the fourth, go below zero between the steps."""
    load = jb.Pedestrian(pace=2.6, activity="jogging", position=12.0)
    record = jb.simulate(case_of(load, duration=2.0))  # without a warning, which would be an error
    lowest = float(record.lowest_contact_force[0])
    assert lowest < 0
    assert (
        f"force of load 0 is negative at times, down to {lowest:.4g} N, as given" in record.verdict
    )
    mass = jb.MovingMass(mass=10.0, speed=3.0)
    assert load_set(case_of(load, mass)).prescribed.tolist() == [True, False]


@pytest.mark.parametrize("step_time", [0.0, 0.13, -0.4])
@pytest.mark.parametrize("activity", ["walking", "jogging"])
def test_force_histories_begin_with_a_step_at_its_time(activity, step_time):
    """A later step delays the force: P(t) = P_0(t - step_time), not P_0(t + step_time)."""
    pace, t = 2.3, np.linspace(0.0, 1.7, 18)
    at_zero, later = (
        jb.Pedestrian(pace=pace, speed=1.5, activity=activity, step_time=own)
        for own in (0.0, step_time)
    )
    found = later.force_histories()[0].at(t)
    assert_allclose(found, at_zero.force_histories()[0].at(t - step_time), atol=1e-9)
    factors, phases = (
        (walking_factors(np.array(pace)), np.zeros(4))
        if activity == "walking"
        else jogging_factors(np.array(pace), contact_time(np.array(pace)), 4)
    )
    expected = [
        700.0 * sum(
            factors[n] * np.sin(2 * np.pi * (n + 1) * pace * (s - step_time) + phases[n])
            for n in range(4)
        )
        for s in t
    ]  # fmt: skip
    assert_allclose(found, expected, atol=1e-9)


def test_paces_of_a_crowd_end_at_three_deviations(monkeypatch):
    """Draws of the standard normal distribution beyond it are rare: some are given, and places."""
    draws = np.linspace(0, 1, 6), np.zeros(6), np.array([-5.0, -3.5, -1.0, 2.9, 3.5, 9.0])
    monkeypatch.setattr(jb.Crowd, "_draws", lambda _: draws)
    crowd = jb.Crowd(people=6, length=9.0, pace=1.9, pace_deviation=0.1, speed=1.4)
    paces = [one.frequencies[0] for one in crowd.force_histories().values()]
    assert_allclose(paces, [1.6, 1.6, 1.8, 2.19, 2.2, 2.2], rtol=1e-12)
    assert_allclose(crowd.vehicle(9.81).offsets, [0.0, 1.8, 3.6, 5.4, 7.2, 9.0], rtol=1e-12)


# Line loads against closed forms and integrals of influence lines.

LENGTH, RIGIDITY = 20.0, 1e10


def line_case_of(load, damping=0.0, duration=30.0, length=LENGTH) -> jb.Case:
    beam = jb.Beam(
        length=length, flexural_rigidity=RIGIDITY, mass_per_length=8000.0, damping_ratio=damping,
        modes=4,
    )  # fmt: skip
    run = jb.Run(duration=duration, sample_rate=20.0)
    return jb.Case(beam, sensors=[jb.Sensor(length / 2)], loads=[load], run=run)


def influence(x, length=LENGTH):
    """Moment at midspan under a unit force at x on a simply supported span."""
    return min(x, length - x) / 2 if 0 <= x <= length else 0.0


def midspan_moment(load, front, length=LENGTH) -> float:
    """Static moment at midspan under the point forces of a load whose front is at a position."""
    wheels = load_set(line_case_of(load, length=length))
    places = front - np.asarray(wheels.behind[0])
    return sum(f * influence(x, length) for f, x in zip(wheels.weight[:, 0], places, strict=True))


def test_a_load_all_over_the_span_is_the_uniform_load():
    """The error falls as the square of the distance of the point forces."""
    expected, errors = 5 * 1e4 * LENGTH**4 / (384 * RIGIDITY), []
    for points in (50, 100, 200):
        load = jb.LineLoad(force_per_length=1e4, lengths=3 * LENGTH, speed=1.0, points=points)
        peak = float(jb.statics.static_peak(line_case_of(load), LENGTH / 2))
        errors.append(peak / expected - 1)
    assert 0 < errors[2] < 1e-4
    assert 3.5 < errors[1] / errors[2] < 4.5 and 3.5 < errors[0] / errors[1] < 4.5


def test_a_standing_load_bends_the_beam_to_its_static_deflection():
    """Over a part of the span, from 4 m to 11 m; the rest of it is on the embankment."""
    load = jb.LineLoad(force_per_length=[2e4, 1e4], lengths=[7.0, 9.0], gaps=[0.0, 2.0],
                       position=11.0, points=20)  # fmt: skip
    case = line_case_of(load, damping=0.3, duration=6.0)
    record = jb.simulate(case)

    def under(x):
        return float(jb.statics.static_deflection(case, LENGTH / 2, [x], [1.0]))

    expected = 2e4 * quad(under, 4.0, 11.0)[0] + 1e4 * quad(under, 0.0, 2.0)[0]
    assert record.deflection[-1, 0] == pytest.approx(expected, rel=2e-3)  # and truncated modes
    assert np.isnan(np.asarray(record.load_position)[-1, -1])  # of a force off the beam


@pytest.mark.parametrize(
    ("model", "length"), [("SW/0", 15.0), ("SW/2", 25.0), ("unloaded-train", 20.0)]
)
def test_moments_of_models_are_integrals(model, length):
    """The first part covers the span, or the load covers it all."""
    code = line_loads()[model]
    load = jb.LineLoad(model=model, speed=10.0, points=200)
    moment = midspan_moment(load, length, length)
    assert moment == pytest.approx(code.force_per_length[0] * length**2 / 8, rel=1e-3)


def test_lm71_has_its_axles_between_its_line_loads():
    load = jb.LineLoad(model="LM71", speed=10.0, tail=60.0, points=600)
    wheels = load_set(line_case_of(load))
    total = float(np.sum(wheels.weight))
    assert total == pytest.approx(2 * 60.0 * 80e3 + 4 * 250e3)
    line = quad(influence, 0, 6.8)[0] + quad(influence, 13.2, LENGTH)[0]
    axles = sum(influence(LENGTH / 2 + at) for at in (-2.4, -0.8, 0.8, 2.4))
    # Symmetrical at midspan: the axles begin 0.8 m behind the first part.
    moment = midspan_moment(load, 60.0 + 3.2 + LENGTH / 2)
    assert moment == pytest.approx(80e3 * line + 250e3 * axles, rel=1e-3)


def test_in_case_files_and_gradients():
    table = {"kind": "line-load", "model": "SW/2", "speed": 20.0}
    beam = {"length": 20.0, "flexural_rigidity": 1e10, "mass_per_length": 8000.0}
    case = case_from_dict({"beam": beam, "loads": [table]})
    check_case(case)
    written = case_to_dict(case)["loads"][0]
    assert written["model"] == "SW/2" and "lengths" not in written

    def peak(numbers):
        load = jb.LineLoad(force_per_length=numbers[0], lengths=numbers[1], speed=1.0, points=10)
        return jb.statics.static_peak(line_case_of(load), LENGTH / 2)

    point = np.array([1e4, 6.0])
    found = jax.grad(peak)(jax.numpy.asarray(point))
    expected = [
        central(lambda x: peak([x[0], 6.0]), point[:1], 10.0)[0],
        central(lambda x: peak([1e4, x[0]]), point[1:], 1e-4)[0],
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"model": "SW/1"}, r"loads.0.model cannot be 'SW/1'; did you mean"),
        ({"model": "SW/0", "lengths": 3.0}, "has both model and lengths; leave one out"),
        ({"lengths": 3.0}, "has neither model nor force_per_length with lengths"),
        ({"lengths": 3.0, "force_per_length": [1.0, 2.0]}, "lengths must be a list as force_per_"),
        ({"lengths": [3.0], "force_per_length": [1.0, 2.0]}, "force_per_length has 2 entries and"),
        ({"model": "SW/0", "position": 3.0}, "has both position and speed; leave one out"),
    ],
)
def test_bad_input_of_line(numbers, words):
    with pytest.raises(ValueError, match=words):
        check_case(line_case_of(jb.LineLoad(**numbers, speed=1.0)))


# Forces that vary in time against scipy: travelling and in place; bad input.

VARYING_LENGTH, VARYING_RIGIDITY, MODES, DAMPING, SPEED = 2.0, 6.0, 3, 0.02, 0.8
TABLE = [0.3, 0.9, 1.4], [0.0, 1.0, -0.5]
VARYING_BEAM = jb.Beam(
    length=VARYING_LENGTH,
    flexural_rigidity=VARYING_RIGIDITY,
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
    return jb.Case(VARYING_BEAM, loads=[load], sensors=[jb.Sensor(1.0)], run=jb.Run(2.6, 100.0))


def force(t):
    waves = 0.7 * np.sin(2 * np.pi * 1.3 * t + 0.2) + 0.2 * np.sin(2 * np.pi * 3.0 * t + 1.0)
    return 2.0 + waves + np.interp(t, *TABLE)


@pytest.mark.parametrize("place", PLACES)
def test_response_is_that_of_scipy(place):
    record = jb.simulate(case_with(**PLACES[place]))
    n = np.arange(1, MODES + 1)
    frequencies = (n * np.pi / VARYING_LENGTH) ** 2 * np.sqrt(VARYING_RIGIDITY)

    def rates(t, y, on_beam):
        x = SPEED * t if place == "travelling" else 0.7
        modal_force = (
            -on_beam * force(t) * np.sin(n * np.pi * x / VARYING_LENGTH) * 2 / VARYING_LENGTH
        )
        q, u = y[:MODES], y[MODES:]
        return np.append(u, modal_force - frequencies**2 * q - 2 * DAMPING * frequencies * u)

    times, state = np.asarray(record.times), np.zeros(2 * MODES)
    midspan = np.zeros(times.size)
    leaves = VARYING_LENGTH / SPEED if place == "travelling" else np.inf
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


BRIDGE_LENGTH, MASS, BRIDGE_DAMPING, WIDTH = 40.0, 2500.0, 0.02, 3.0
BRIDGE = jb.Case(jb.Beam(BRIDGE_LENGTH, 10.4e9, MASS, damping_ratio=BRIDGE_DAMPING, modes=2))


@pytest.mark.parametrize(
    ("density", "people", "in_step"),
    [("TC3", 60.0, 10.8 * np.sqrt(BRIDGE_DAMPING * 60)), (1.5, 180.0, 1.85 * np.sqrt(180))],
)
def test_stream_on_a_pinned_beam(density, people, in_step):
    """2 p / (pi m zeta) of any mode, as |sin| has the mean 2 / pi."""
    found = stream_response(BRIDGE, density, WIDTH, reduction=[1.0, 0.25])
    assert_allclose(found.equivalent, in_step, rtol=1e-9)
    expected = 2 * 280 * in_step / BRIDGE_LENGTH / (np.pi * MASS * BRIDGE_DAMPING)
    assert_allclose(found.accelerations, [expected, expected / 4], rtol=1e-5)
    assert list(found.columns["comfort class"]) == [comfort_class(expected * s) for s in (1, 0.25)]


def test_people_in_step_have_the_acceleration_of_the_stream():
    """Thirty people of a share of the force each, in the direction of the second mode, in time."""
    found = stream_response(BRIDGE, "TC2", WIDTH, reduction=1.0)
    count = 30
    amplitude, pace = 280 * found.equivalent[1] / count, [found.frequencies[1]]
    people = [
        jb.VaryingForce(frequencies=pace, amplitudes=[amplitude], phases=[phase], position=at)
        for half, phase in ((0.0, 0.0), (BRIDGE_LENGTH / 2, np.pi))
        for at in half + (np.arange(count // 2) + 0.5) * BRIDGE_LENGTH / count
    ]
    run = jb.Run(6.0, sample_rate=200.0)  # six time constants
    case = jb.Case(BRIDGE.beam, loads=people, sensors=[jb.Sensor(10.0, "acceleration")], run=run)
    record = jb.simulate(case)
    last = np.asarray(record.sensor_values[record.times > 5.0, 0])
    assert_allclose(np.abs(last).max(), found.accelerations[1], rtol=0.01)


def test_modes_are_pushed_by_the_nearest_harmonic():
    """Modes of 2 and 8 Hz, the first and the fourth harmonic of a pace of 1.89 Hz (CSA S7)."""
    found = stream_response(BRIDGE, "TC3", WIDTH)
    assert_allclose(found.frequencies, [2.0, 8.0], rtol=2e-3)
    whole = stream_response(BRIDGE, "TC3", WIDTH, reduction=1.0)
    assert_allclose(found.accelerations / whole.accelerations, [1.0, 0.041 / 0.4], rtol=1e-12)


@pytest.mark.parametrize(
    ("density", "frequency", "of_weight"),
    [(1.0, 1.643, 0.4), (1.0, 0.82, 0.0), (1.0, 2.46, 0.4), (1.0, 2.47, 0.1), (0.2, 9.03, 0.041)]
    + [(0.2, 9.3, 0.027), (0.2, 11.3, 0.027), (0.2, 11.4, 0.0)],
)
def test_forces_of_harmonics(density, frequency, of_weight):
    """Paces of 1.643 and 2.063 Hz by hand."""
    found = harmonic_fractions(np.array([frequency]), density)
    assert_allclose(0.4 * found, of_weight, atol=1e-12)


def test_comfort_classes_and_wrong_numbers():
    assert [comfort_class(a) for a in (0.5, 0.51, 2.5, 2.6)] == ["CL1", "CL2", "CL3", ""]
    with pytest.raises(ValueError, match="no traffic class 'TC9'"):
        stream_response(BRIDGE, "TC9", WIDTH)
    with pytest.raises(ValueError, match="width must be positive"):
        stream_response(BRIDGE, "TC3", 0.0)
