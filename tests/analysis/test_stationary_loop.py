"""Loops with a stationary mass against matrices assembled here, and the verdict of all commands."""

import dataclasses
import json

import control
import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop, loop_with_mass_at, stationary_loops
from jaxbeam.analysis.stability import growth, loop_gain, margins, stability_margin
from jaxbeam.case.controller import AbstractStaticController
from jaxbeam.cli import main
from tests.loop_as_oracle import span_of

GAIN, PLACE, SENSOR, BANDWIDTH, FORCE = 40.0, 0.22, 0.25, 150.0, 5.0
POSITION, MASS, PERIOD, CUBIC = 0.35, 0.8, 0.005, 3e9


def lagging_case() -> jb.Case:
    """Feedback through the lag of a shaker without suspension, in continuous time."""
    shaker = jb.Shaker(PLACE, 0.0, 0.0, force_per_volt=FORCE, bandwidth=BANDWIDTH)
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[shaker],
        sensors=[jb.Sensor(SENSOR)],
        loads=[jb.MovingMass(mass=0.3, speed=1.0)],
        controller=jb.Feedback([GAIN]),
        run=jb.Run(0.6),
    )


def loop_of_matrices(case) -> control.StateSpace:
    """From the command to the negative command of the law, with the mass at its position."""
    span, n = span_of(case), 2
    shape = span.shapes(POSITION)
    compliance = np.linalg.inv(np.eye(n) + MASS * np.outer(shape, shape))
    below = -compliance @ np.hstack([np.diag(span.frequencies**2), span.damping])
    A = np.zeros((2 * n + 1, 2 * n + 1))
    A[:n, n : 2 * n], A[n : 2 * n, : 2 * n] = np.eye(n), below
    A[n : 2 * n, -1] = compliance @ span.shapes(PLACE)
    A[-1, -1] = -BANDWIDTH
    B = np.append(np.zeros(2 * n), BANDWIDTH * FORCE)[:, None]
    C = GAIN * np.append(span.shapes(SENSOR), np.zeros(n + 1))
    return control.StateSpace(A, B, C, 0)


def test_margins_and_responses_with_a_mass_at_a_position():
    case = lagging_case()
    loop, expected = loop_with_mass_at(case, POSITION, MASS), loop_of_matrices(case)
    found = margins(loop)
    gain, phase, modulus, *_ = control.stability_margins(expected)
    assert_allclose(found.gain, gain, rtol=1e-6)
    assert_allclose(found.phase, np.radians(phase), rtol=1e-6)
    assert_allclose(found.modulus_margin, modulus, rtol=1e-5)
    frequencies = np.geomspace(1.0, 2000.0, 15)
    response = control.frequency_response(expected, frequencies).complex
    scale = np.max(np.abs(response))
    assert_allclose(-loop_gain(loop)[1](frequencies), response, atol=1e-9 * scale)
    exported = control.frequency_response(loop.to_control(), frequencies).complex
    assert_allclose(-exported, response, atol=1e-9 * scale)
    with pytest.raises(ValueError, match="off the beam, 0 to 0.6 m"):
        loop_with_mass_at(case, 0.7, MASS)


class GrowingGain(AbstractStaticController):
    """Feedback of the first reading by a gain that grows by its value at t = 0 in each second."""

    def command(self, state, measurement, t):
        return -GAIN * (1 + t) * measurement.readings[:1]


@pytest.mark.parametrize(
    ("loads", "time"),
    [
        ((), 0.0),
        ((jb.MovingMass(mass=0.3, speed=2.0, entry_time=0.4),), 0.4 + POSITION / 2),
        ((jb.MovingMass(mass=0.3, speed=-2.0, entry_time=0.4),), 0.4 + (0.6 - POSITION) / 2),
        ((jb.MovingMass(mass=0.3, speed=2.0, deceleration=20.0, entry_time=0.4),), 0.0),
        ((jb.MovingMass(mass=0.3, times=[0.2, 0.7], positions=[0.0, 0.3]),), 0.0),
        ((jb.VaryingForce(force=3.0, position=POSITION, entry_time=0.4),), 0.0),
    ],
    ids=["no load", "to the right", "to the left", "stops before", "table ends before", "stands"],
)
def test_a_law_is_that_of_the_passage_of_the_first_load(loads, time):
    """A load that passes a place gives the time of a law there; else that is t = 0."""
    case = dataclasses.replace(lagging_case(), controller=GrowingGain(), loads=loads)
    expected = (1 + time) * loop_of_matrices(case)
    found = loop_with_mass_at(case, POSITION, MASS).to_control()
    assert_allclose(-response(found), response(expected), rtol=1e-8)


def cubic_case() -> jb.Case:
    """A cubic law without gain at rest, whose gain under the load is too large for its delay."""
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.005, modes=1),
        actuators=[jb.PointForce(0.3)],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.5, speed=1.0)],
        controller=jb.Feedback([CUBIC], power=3, period=PERIOD, delay=PERIOD),
        run=jb.Run(0.6, 200.0),
    )


def test_a_cubic_law_has_no_gain_at_rest_and_is_unstable_under_the_load():
    case = cubic_case()
    assert margins_at_rest(case) == np.inf and np.max(growth(case, 20).factor) < 1.1
    assert stability_margin(case).verdict == "unstable"


def test_a_cubic_law_under_a_vehicle_is_linear_about_their_equilibrium():
    """In continuous time, with the states of a quarter car; matrices assembled here."""
    body, axle, suspension, damper, tyre, wall = 0.2, 0.1, 300.0, 2.0, 4000.0, 1.5
    car = jb.QuarterCar(
        body_mass=body,
        axle_mass=axle,
        suspension_stiffness=suspension,
        suspension_damping=damper,
        tyre_stiffness=tyre,
        tyre_damping=wall,
        times=[0.0, 3.0],
        positions=[POSITION, POSITION],
    )
    case = dataclasses.replace(cubic_case(), loads=(car,), controller=jb.Feedback([CUBIC], power=3))
    span = span_of(case)
    (at_load,), (at_sensor,) = span.shapes(POSITION), span.shapes(0.3)
    (stiffness,), damping = span.frequencies**2, span.damping[0, 0]
    weight = (body + axle) * 9.81 * at_load

    def force_left(y):
        return stiffness * y / at_sensor + at_sensor * CUBIC * y**3 + weight

    y = scipy.optimize.brentq(force_left, -0.1, 0.0)
    gain = 3 * CUBIC * y**2 * at_sensor**2
    K = [
        [stiffness + gain + tyre * at_load**2, 0.0, -tyre * at_load],
        [0.0, suspension, -suspension],
        [-tyre * at_load, -suspension, suspension + tyre],
    ]
    C = [
        [damping + wall * at_load**2, 0.0, -wall * at_load],
        [0.0, damper, -damper],
        [-wall * at_load, -damper, damper + wall],
    ]
    inertia = np.array([1.0, body, axle])[:, None]
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.array(K) / inertia, -np.array(C) / inertia]])
    found = np.sort_complex(linearised_loop(case, 0.5).poles())
    assert_allclose(found, np.sort_complex(np.linalg.eigvals(A)), rtol=1e-8)
    assert gain > stiffness  # the equilibrium matters


def margins_at_rest(case) -> float:
    with np.errstate(divide="ignore"):
        return margins(linearised_loop(case, -1.0)).gain


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    jb.save_case(cubic_case(), "case.toml")

    def run(line: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(line.split())
        text = capsys.readouterr()
        assert ended.value.code == 0, text.err
        return text.out

    return run


def test_commands_have_one_verdict(printed, tmp_path):
    sentence = str(stability_margin(cubic_case()))
    text = printed("stability case.toml --mass-at 0.3=0.5 --mass-at 0.01=0.1 --plot")
    assert f"the loop is {sentence}" in text
    assert "unstable with 0.5 kg at 0.3 m" in text and "0.1 kg at 0.01 m  " in text
    assert (tmp_path / "case_poles.png").exists() and (tmp_path / "case_loop.png").exists()
    assert f"the loop is {sentence}" in printed("simulate case.toml")
    assert sentence in printed("compare case.toml --period 0.05")
    found = json.loads(printed("stability case.toml --json"))
    assert found["verdict"] == "unstable" and found["stable_without_loads"]


def observed_case(loads: str, nominal_force: float = FORCE) -> jb.Case:
    """A regulator on a Kalman filter, designed for an actuator of another force, maybe."""
    weight_deviation = 1.0 if loads == "estimated" else None
    estimator = jb.Kalman(
        process_noise=0.1, measurement_noise=1e-5, loads=loads, weight_deviation=weight_deviation
    )
    controller = jb.LQR(
        state_weight=[1e6, 1e6, 0.0, 0.0, 0.0],
        command_weight=[1e-2],
        period=PERIOD,
        estimator=estimator,
        sampling="exact",
    )
    case = dataclasses.replace(lagging_case(), controller=controller)
    nominal = jb.state_space(jb.replace(case, {"actuators.0.force_per_volt": nominal_force}))
    controller = dataclasses.replace(controller, nominal_plant=nominal)
    return dataclasses.replace(case, controller=controller)


@pytest.mark.parametrize("loads", ["known", "estimated"])
@pytest.mark.parametrize(("nominal_force", "verdict"), [(FORCE, "stable"), (FORCE / 3, "unstable")])
def test_a_filter_settles_under_stationary_loads(loads, nominal_force, verdict):
    """Its covariance depends on the way here, but tends to that of loads at rest."""
    found = stability_margin(observed_case(loads, nominal_force), verdict_only=True)
    assert found.verdict == verdict and not found.obstacle


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@pytest.mark.parametrize("nominal_force", [FORCE, FORCE / 3])
def test_poles_with_a_settled_filter_are_those_of_a_run(nominal_force):
    """Readings of a load that stands obey the difference equation with these poles."""
    case = observed_case("known", nominal_force)
    standing = jb.MovingMass(mass=0.3, times=[0.0, 3.0], positions=[POSITION, POSITION])
    case = dataclasses.replace(case, loads=(standing,), run=jb.Run(0.9, 1 / PERIOD))
    nominal = jb.state_space(jb.replace(case, {"actuators.0.force_per_volt": nominal_force}))
    controller = dataclasses.replace(case.controller, nominal_plant=nominal)
    case = dataclasses.replace(case, controller=controller)
    (loop,) = stationary_loops(case, [0.5])
    assert (loop.poles()[0].real > 0) == (nominal_force < FORCE)
    coefficients = np.poly(np.linalg.eigvals(loop.closed_matrix)).real
    changes = np.diff(np.asarray(jb.simulate(case).deflection)[100:, 0])
    left = np.convolve(changes, coefficients, "valid")
    assert_allclose(left, 0.0, atol=1e-7 * np.max(np.convolve(abs(changes), abs(coefficients))))
    wrong = np.poly(1.02 * np.linalg.eigvals(loop.closed_matrix)).real
    assert np.max(np.abs(np.convolve(changes, wrong, "valid"))) > 30 * np.max(np.abs(left))


# Objects of python-control against matrices assembled here, poles, and a simulated run.

FREQUENCIES = np.geomspace(1.0, 2000.0, 9)  # rad/s


def response(system):
    return control.frequency_response(system, FREQUENCIES, squeeze=False).complex


def test_continuous_loop_with_a_mass_at_a_position():
    """Of open and closed loop: poles and frequency responses."""
    systems, expected = (
        jb.to_control(lagging_case(), POSITION, MASS),
        loop_of_matrices(lagging_case()),
    )
    scale = np.abs(response(expected)).max()
    assert_allclose(-response(systems.loop), response(expected), atol=1e-9 * scale)
    closed = control.feedback(expected, 1)
    assert_allclose(np.sort_complex(systems.closed.poles()), np.sort_complex(closed.poles()))
    assert_allclose(
        np.sort_complex(systems.plant.poles()), np.sort_complex(expected.poles()), rtol=1e-9
    )


def test_plant_from_the_weight_to_the_reading():
    """-psi(sensor)' (K - w^2 M + i w C)^-1 psi(position), M with the mass."""
    case = dataclasses.replace(lagging_case(), controller=None)
    plant, loop, closed = jb.to_control(case, POSITION, MASS)
    assert (plant.input_labels, plant.output_labels) == (
        ["command_0", "load_0"],
        ["sensor_0_deflection"],
    )
    assert loop is None and closed is None
    span = span_of(case)
    shape, reading = span.shapes(POSITION), span.shapes(SENSOR)
    inertia = np.eye(2) + MASS * np.outer(shape, shape)
    stiffness = np.diag(span.frequencies**2)
    expected = [
        -reading @ np.linalg.solve(stiffness - w**2 * inertia + 1j * w * span.damping, shape)
        for w in FREQUENCIES
    ]
    scale = np.abs(expected).max()
    assert_allclose(response(plant)[0, 1], expected, atol=1e-9 * scale)


def test_sampled_loop_has_its_period_and_poles():
    controller = jb.Feedback([40.0], period=0.004, delay=0.001)
    case = dataclasses.replace(lagging_case(), controller=controller)
    systems = jb.to_control(case, POSITION)  # with the 0.3 kg of its load
    assert systems.closed.dt == 0.004 and systems.closed.output_labels == ["law_0"]
    poles = loop_with_mass_at(case, POSITION, 0.3).poles()
    found = np.log(systems.closed.poles().astype(complex)) / 0.004
    kept = poles[poles.real > -1e4]
    assert_allclose(np.sort_complex(found[found.real > -1e4]), np.sort_complex(kept), rtol=1e-6)
    unloaded = jb.to_control(case)
    assert unloaded.plant.input_labels == ["command_0"]
    assert np.abs(unloaded.closed.poles() - systems.closed.poles()).max() > 1e-3
    without = jb.to_control(dataclasses.replace(case, loads=()))
    assert_allclose(without.closed.poles(), unloaded.closed.poles())


def test_errors():
    case = lagging_case()
    with pytest.raises(ValueError, match="mass needs a position"):
        jb.to_control(case, mass=0.2)
    with pytest.raises(ValueError, match="the mass at 0.7 m is off the beam"):
        jb.to_control(case, 0.7)
    with pytest.raises(ValueError, match="mass must be given"):
        jb.to_control(dataclasses.replace(case, loads=()), 0.2)
