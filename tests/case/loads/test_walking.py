"""Steps of pedestrians and crowds: published factors, half-sine pulses, resonance, bad input."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad, solve_ivp

import jaxbeam as jb
from jaxbeam.case.loads.walking import contact_time, jogging_factors, walking_factors
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.model.load_set import load_set

BEAM = jb.Beam(
    length=30.0, flexural_rigidity=2.87e9, mass_per_length=1500.0, damping_ratio=0.005, modes=2
)
FREQUENCY = np.pi / 2 / 30.0**2 * np.sqrt(2.87e9 / 1500.0)  # Hz


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


def test_contact_time_of_a_jogger():
    assert_allclose(contact_time(np.array(2.5)), 0.2751, atol=1e-4)  # 1.8 x 2.5^-2.05


def test_a_pedestrian_on_the_spot_is_that_of_scipy():
    """In resonance with the first mode, one step a period."""
    load = jb.Pedestrian(pace=FREQUENCY, position=12.0, step_time=0.1)
    record = jb.simulate(case_of(load, duration=8.0))
    n, times = np.arange(1, 3), np.asarray(record.times)
    frequencies = (n * np.pi / 30.0) ** 2 * np.sqrt(2.87e9 / 1500.0)
    shape = np.sin(n * np.pi * 12.0 / 30.0) * 2 / (1500.0 * 30.0)
    factors = walking_factors(np.array(FREQUENCY))

    def rates(t, y):
        angles = 2 * np.pi * FREQUENCY * np.arange(1, 5) * (t - 0.1)
        force = 700.0 * (1 + factors @ np.sin(angles))
        q, u = y[:2], y[2:]
        return np.append(u, -force * shape - frequencies**2 * q - 0.01 * frequencies * u)

    solution = solve_ivp(rates, (0, 8.0), np.zeros(4), t_eval=times, rtol=1e-10, atol=1e-14)
    expected = np.sin(n * np.pi / 2) @ solution.y[:2]
    size = np.max(np.abs(expected))
    assert_allclose(record.deflection[:, 0], expected, atol=1e-6 * size)
    # Near the closed form of resonance at rest: F / (2 k zeta) (1 - exp(-zeta w t)).
    modal = 700.0 * factors[0] * shape[0] / (2 * 0.005 * frequencies[0] ** 2)
    grown = modal * (1 - np.exp(-0.005 * frequencies[0] * 8.0))
    static = 700.0 * shape[0] / frequencies[0] ** 2
    last = np.asarray(record.deflection)[times > 7.0, 0] + static
    assert_allclose(np.max(np.abs(last)), grown, rtol=0.1)


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


def test_in_case_files():
    loads = [
        {"kind": "pedestrian", "pace": 2.0, "speed": 1.5, "factors": [0.4, 0.1], "phases": [0, 1]},
        {
            "kind": "crowd",
            "people": 3,
            "length": 10.0,
            "pace": 2.5,
            "activity": "jogging",
            "speed": 3.0,
        },
    ]
    beam = {"length": 30.0, "flexural_rigidity": 2.87e9, "mass_per_length": 1500.0}
    case = case_from_dict({"beam": beam, "loads": loads})
    check_case(case)
    assert isinstance(case.loads[1], jb.Crowd)


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
    """Draws of the standard normal distribution beyond it are rare: some are given."""
    draws = np.zeros(6), np.zeros(6), np.array([-5.0, -3.5, -1.0, 2.9, 3.5, 9.0])
    monkeypatch.setattr(jb.Crowd, "_draws", lambda _: draws)
    crowd = jb.Crowd(people=6, length=9.0, pace=1.9, pace_deviation=0.1, speed=1.4)
    paces = [one.frequencies[0] for one in crowd.force_histories().values()]
    assert_allclose(paces, [1.6, 1.6, 1.8, 2.19, 2.2, 2.2], rtol=1e-12)
